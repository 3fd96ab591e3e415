"""Record foreign traffic, and compare two recordings."""
