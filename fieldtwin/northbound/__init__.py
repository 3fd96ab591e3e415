"""Servers of tags for other systems that need heavy libraries. Each runs in a separate process and reads the process image."""
