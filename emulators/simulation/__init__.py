"""Simulated values for emulated devices, instead of recordings: from formulas, a Python model or an FMU, in steps of the
emulator's clock.
"""
