"""Our own Modbus server for emulated devices: bank (data), unit (functions), rtu and mbap (framing), serve (asyncio).

It shares no code with the master that it answers: a mistake in common code would cancel itself out.
"""
