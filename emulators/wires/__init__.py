"""Models of what carries frames: a serial line, a CAN bus with arbitration and errors, an acoustic channel."""
