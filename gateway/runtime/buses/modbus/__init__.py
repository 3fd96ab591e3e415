"""A Modbus bus of the gateway: its connection, the order of its requests, and devices that do not answer."""
