"""Read all registers or objects of a device into a file (a dump), and compare such dumps."""
