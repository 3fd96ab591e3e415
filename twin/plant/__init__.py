"""The physical twin: gateway and PLC of a system on a real plant, and the processes and files of one run."""
