"""The objects that tests of drivers use: devices, field simulators, connections, programs and scenarios.

Another process runs them. Nothing here imports more than the standard library: the process may live in a separate
virtual environment or image.
"""
