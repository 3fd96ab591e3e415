"""Virtual context by simulation: values from formulas or a Python model, stepped by the emulator's clock (SPEC prose 9)."""
