"""A hostile Modbus server, and the cases in which a client has to cope with it."""
