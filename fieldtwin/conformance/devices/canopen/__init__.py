"""Conformance tests of CANopen nodes."""
