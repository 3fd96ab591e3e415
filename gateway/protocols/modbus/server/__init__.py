"""The Modbus servers of the gateway, without I/O: parse the requests of clients, check them, and forward them to devices."""
