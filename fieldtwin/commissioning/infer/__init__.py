"""Infer the meaning of registers from dumps."""
