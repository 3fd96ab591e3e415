"""Conformance tests of Modbus devices."""
