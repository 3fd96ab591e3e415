"""Faults of nodes on a CAN bus."""
