"""Dump everything that a device holds into a file, and compare such dumps."""
