"""Drawings of systems: who hangs on which wire, as text and as SVG."""
