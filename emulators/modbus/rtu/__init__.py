"""Modbus RTU on a line with several servers: finding the frames, and selecting those that a unit answers."""
