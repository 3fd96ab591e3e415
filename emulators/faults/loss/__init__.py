"""Faults that lose or repeat frames, or break the connection."""
