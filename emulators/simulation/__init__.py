"""A simulation as virtual context: values from formulas or a Python model, in steps of the emulator's clock."""
