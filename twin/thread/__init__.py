"""The digital thread: two logs that are made equal over TCP, MQTT, or the modem of the plant."""
