"""The soft PLC: scan cycle, tasks, programs in Python and Structured Text. It depends on no bus, driver, emulator or twin."""
