"""The Modbus servers of the gateway: they parse requests of the gateway's clients, and forward them to devices."""
