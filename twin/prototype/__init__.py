"""The digital twin prototype: the same gateway and PLC with simulated field devices, and the injection of faults."""
