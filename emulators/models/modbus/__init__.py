"""Emulated Modbus devices: the models behind a unit's registers, and a modem with a mailbox."""
