"""The software CAN bus as a server, its clients on the simulated side, and serial CAN adapters (slcan)."""
