"""CAN buses: SocketCAN, adapters that python-can knows, and the software bus."""
