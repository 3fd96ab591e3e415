"""Outputs: the values that the PLC commands, the values that devices hold, and the writes that were refused."""
