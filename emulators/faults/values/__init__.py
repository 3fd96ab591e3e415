"""Faults that change the values of an emulated device."""
