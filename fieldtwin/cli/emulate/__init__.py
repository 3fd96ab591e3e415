"""Commands that emulate devices, buses and links, and list the faults."""
