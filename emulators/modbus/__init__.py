"""Modbus server of the emulated devices: a unit with its data (bank) and functions, and the frames of RTU, ASCII and MBAP.

The server shares no code with the project's Modbus client: a mistake in common code would cancel itself out.
"""
