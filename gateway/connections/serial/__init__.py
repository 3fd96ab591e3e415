"""Serial ports: opening a port, its settings and counters, and connections on it."""
