"""Faults that damage the bytes of a frame."""
