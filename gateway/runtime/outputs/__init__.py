"""Outputs: what the PLC commands, what a device holds, and what was refused."""
