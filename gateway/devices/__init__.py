"""Device drivers: a profile and a protocol client become tags."""
