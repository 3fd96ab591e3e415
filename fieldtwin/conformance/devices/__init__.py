"""Conformance tests of Modbus and CANopen devices, from outside."""
