"""TCP, TLS and UDP: connections to devices, and listeners for the gateway's clients."""
