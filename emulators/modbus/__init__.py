"""Modbus server of the emulated devices: bank (data), unit (functions), rtu and mbap (framing), serve (asyncio).

The server shares no code with the project's Modbus client: a mistake in common code would cancel itself out.
"""
