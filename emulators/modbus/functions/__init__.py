"""The Modbus functions of a unit, by the data that they access."""
