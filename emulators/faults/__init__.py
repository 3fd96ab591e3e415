"""Faults that can be injected into a link or a device: one file per fault, one name.

`registry.FAULTS` lists all of them.
"""
