"""The soft PLC. Stands on gateway.core alone: it never knows a bus, a driver, an emulator or a twin."""
