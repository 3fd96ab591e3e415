"""The Modbus client, one transaction at a time, and the gateway's Modbus servers, above requests and framings.

This package handles bytes and is given a clock. It does not know which device, bus or process it serves. Only `requests.pdus`
imports pymodbus.
"""
