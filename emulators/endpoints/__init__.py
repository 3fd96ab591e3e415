"""The simulated side's ends of serial lines, sockets and CAN buses, of the operating system or in memory."""
