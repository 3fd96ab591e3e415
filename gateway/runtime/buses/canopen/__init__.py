"""A CAN bus of the gateway: the boot-up of its nodes, and the writes to them."""
