"""The digital thread: synchronizes the logs of two twins over TCP, MQTT, or the modem of the plant."""
