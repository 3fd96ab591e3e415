"""The Modbus client: requests, framings, one transaction at a time, and the client around them.

This package knows bytes and a clock that it is given, but not which device, bus or process it serves. Only `pdus`
imports pymodbus.
"""
