"""A run in real time: one system, or a network of systems on this host, and its verdict."""
