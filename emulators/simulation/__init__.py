"""Simulated values for emulated devices, instead of recordings: from formulas or a Python model, in steps of the emulator's
clock.
"""
