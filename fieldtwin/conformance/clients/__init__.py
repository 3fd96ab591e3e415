"""Conformance tests of Modbus clients and CANopen masters, against hostile devices."""
