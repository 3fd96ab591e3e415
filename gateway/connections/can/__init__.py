"""CAN buses: SocketCAN, adapters that python-can supports, and the software CAN bus (a bus simulated by a TCP server)."""
