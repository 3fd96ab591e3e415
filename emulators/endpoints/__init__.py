"""The ends of serial lines, sockets and CAN buses that the simulated field devices use: real ones or ones in memory."""
