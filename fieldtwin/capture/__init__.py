"""Recorded traffic: its file formats, its decoding, and recordings of devices."""
