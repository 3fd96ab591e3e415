"""Process data: the mapping of objects to PDOs, and the SYNC messages that trigger PDOs."""
