"""Drawings of a system: which devices are connected to which bus, as text and as SVG."""
