"""Faults that can be injected into a link or a device: each fault has its own file and a name.

`registry.FAULTS` lists all of them.
"""
