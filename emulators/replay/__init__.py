"""Emulated devices that answer from a recording of exchanges."""
