"""Properties of devices that a profile cannot express."""
