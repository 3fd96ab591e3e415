"""The PLC process: its tasks by priority, on the wall clock, with retained variables and a control channel."""
