"""Asset Administration Shells: the interface description of a profile, and packages that carry a template (extra `aas`)."""
