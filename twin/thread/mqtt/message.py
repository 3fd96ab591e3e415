"""A message for an MQTT broker."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class MqttMessage:
    """A message to publish. `qos` is 0 to 2; the broker keeps a message with `retain` for later subscribers."""

    topic: str
    payload: bytes
    qos: int = 0
    retain: bool = False
