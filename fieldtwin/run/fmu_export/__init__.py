"""The export of a prototype as an FMU (FMI 2.0, co-simulation), with which a simulation tool drives the PLC in virtual time."""
