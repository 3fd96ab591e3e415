"""Faults that can be put on a wire or into a device: one file a fault, one name. `registry.FAULTS` has them all."""
