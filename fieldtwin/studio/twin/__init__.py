"""Shadows and twins of an instance, the comparison with their models, and forecasts."""
