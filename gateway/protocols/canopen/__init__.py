"""The CANopen master (CiA 301): protocol modules without I/O, which are given frames and the time, and a thin asyncio layer
that connects them to a bus.

"CO-" and a number, in these modules, is a test case (tests/vectors).
"""
