"""A run as a system service: metrics, systemd notifications, journal events and reloading."""
