"""Modbus, the master's side: requests, framings, one transaction at a time, and the client around them.

Knows bytes and a clock that it is given; never which device, bus or process it serves. pymodbus is imported in `pdus`
and nowhere else.
"""
