"""What tests of somebody's drivers hold: devices, field sides, wires, programs and scenarios, run by a process elsewhere.

Nothing here imports more than the standard library: the process may live in a virtual environment or an image of its own.
"""
