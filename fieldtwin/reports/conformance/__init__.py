"""Reports of conformance tests as HTML."""
