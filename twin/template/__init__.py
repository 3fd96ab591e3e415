"""The digital template: a system, and all that it needs, as one file."""
