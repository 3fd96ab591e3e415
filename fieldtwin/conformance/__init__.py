"""Conformance tests: of devices from outside (`devices`), and of clients against hostile devices (`clients`)."""
