"""The digital template: a system and everything that it needs, as one file."""
