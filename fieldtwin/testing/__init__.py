"""The objects that tests of drivers use: devices, field simulators, connections, programs and scenarios.

A separate process runs them, possibly in a different virtual environment or image. These objects therefore need only the
standard library.
"""
