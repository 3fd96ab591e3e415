"""The soft PLC. Stands on fieldtwin.gateway.core alone: it never knows a bus, a driver, an emulator or a twin."""
