"""Inheritance of function blocks, classes and interfaces, as far as the tree shows it."""
