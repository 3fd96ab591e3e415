"""Findings of `fieldtwin plc check`: constructs that every dialect accepts and that are often mistakes."""
