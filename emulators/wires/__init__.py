"""Models of the media that carry frames: a serial line, a CAN bus with arbitration and errors, an acoustic channel."""
