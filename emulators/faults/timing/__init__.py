"""Faults that deliver frames late, early or in pieces."""
