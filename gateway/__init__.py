"""The gateway: protocols, device drivers, the process image, and the runtime that polls and writes."""
