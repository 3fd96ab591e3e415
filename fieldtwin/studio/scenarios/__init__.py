"""Scenarios in Studio: recorded from the actions of clients on a prototype, and run as a child process. Independent of HTTP."""
