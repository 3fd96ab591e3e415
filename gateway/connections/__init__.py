"""Open connections of the operating system: serial ports, TCP, TLS, UDP, CAN."""
