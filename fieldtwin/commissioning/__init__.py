"""Commissioning of one real device: scan, identify, read, write, dump, infer, record.

Each command listens before it sends, and asks for confirmation before it writes.
"""
