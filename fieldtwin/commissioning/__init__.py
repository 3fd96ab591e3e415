"""Commissioning of one real device: scan, identify, read, write, dump, infer, record.

Each command listens before it sends, and confirms before it writes.
"""
