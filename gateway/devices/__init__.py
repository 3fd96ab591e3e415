"""Device drivers: each reads and writes one device as its profile describes, and publishes the values as tags."""
