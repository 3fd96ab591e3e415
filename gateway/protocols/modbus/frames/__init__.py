"""The framings of Modbus: RTU, ASCII, and the MBAP header of TCP, TLS and UDP."""
