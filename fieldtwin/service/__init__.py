"""A run as a service: what watches it (metrics, systemd, the journal) and what it is told (reload)."""
