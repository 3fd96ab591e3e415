"""Modbus and CANopen without I/O: bytes and times in, bytes and results out."""
