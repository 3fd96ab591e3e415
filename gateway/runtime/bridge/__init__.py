"""The bridge: Modbus clients of the gateway reach units on its buses."""
