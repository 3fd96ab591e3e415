"""Error detection and error reports of the emulated node: emergency messages, heartbeats, guarding, CAN controller events."""
