"""Faults that change a Modbus reply and keep its frame intact."""
