"""The soft PLC. It depends only on fieldtwin.gateway.core and does not know a bus, a driver, an emulator or a twin."""
