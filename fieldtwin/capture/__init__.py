"""Recorded traffic: the file formats it is kept in, its decoding, and recordings of devices."""
