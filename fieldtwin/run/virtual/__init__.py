"""A run in virtual time: one system or a network of systems in one event loop."""
