"""`fieldtwin emulate`: the simulated field devices of a system, or one device, in this process."""
