"""Symbolic execution of compiled programs: compiled code and function blocks run on values that are not known."""
