"""Scenarios in Studio: recorded from what clients do to a prototype, and run as a child process. It does not know HTTP."""
