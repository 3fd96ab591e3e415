"""The bridge, through which Modbus clients of the gateway reach units on its buses."""
