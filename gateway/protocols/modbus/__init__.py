"""The Modbus client: requests, framings, one transaction at a time, and the client around them.

This package handles bytes and is given a clock. It does not know which device, bus or process it serves. Only `pdus` imports
pymodbus.
"""
