"""Unit tests in Structured Text: TEST blocks, which run in their own virtual time."""
