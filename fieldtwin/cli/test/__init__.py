"""Commands that test: scenarios and conformance tests."""
