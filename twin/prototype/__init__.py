"""The digital twin prototype: the same gateway and PLC opposite simulated devices, and the faults that are put in."""
