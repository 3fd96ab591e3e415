"""Importing PLCopen XML into the tree of Structured Text."""
