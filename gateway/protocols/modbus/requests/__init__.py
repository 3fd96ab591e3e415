"""The requests of a Modbus client by function code, their replies, and the exceptions with which a server refuses them."""
