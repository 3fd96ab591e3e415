"""The soft PLC: scan cycle, tasks, programs in Python and Structured Text. It knows no bus, driver, emulator or twin."""
