"""The software CAN bus as a server, the ends by which emulated nodes join it, and serial CAN adapters (slcan)."""
