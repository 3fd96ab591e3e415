"""Campaigns: one scenario or run with many seeds, and the smallest faults that still make it fail."""
