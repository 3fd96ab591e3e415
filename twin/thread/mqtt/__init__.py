"""MQTT: the session with a broker and its messages (the extra `mqtt`)."""
