"""Commands that run systems, and their views."""
