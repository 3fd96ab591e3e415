"""A Sparkplug host application for tests, which shares no code with fieldtwin: paho is its client, and the generated code of
Eclipse Tahu's definition (in pysparkplug) its decoder.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import paho.mqtt.client as paho
import pytest


@dataclass(frozen=True)
class Received:
    """A message: its kind (such as DDATA), the device or "", the decoded payload, QoS, the retain flag, and the bytes."""

    kind: str
    device: str
    payload: Any
    qos: int
    retain: bool
    data: bytes

    @property
    def by_name(self) -> dict[str, Any]:
        """The metrics of a birth by name."""
        return {metric.name: metric for metric in self.payload.metrics}


def property_of(metric: Any, name: str) -> Any:
    """Return the value of a property of a metric, or None."""
    for key, value in zip(metric.properties.keys, metric.properties.values, strict=True):
        if key == name:
            return getattr(value, value.WhichOneof("value"))
    return None


def value_of(metric: Any) -> Any:
    """Return the value of a metric; None if it is null."""
    field = metric.WhichOneof("value")
    return None if metric.is_null or field is None else getattr(metric, field)


class Host:
    """A connected host application of the group ``plant``. It records every message of the edge node ``hall``."""

    def __init__(self, port: int, *, node: str = "hall", name: str = "scada") -> None:
        self._pb = pytest.importorskip("pysparkplug._protobuf", reason="no pysparkplug here")
        self.node = node
        self.messages: list[Received] = []
        self._name = name
        self._began_ms = int(time.time() * 1000)
        self._subscribed = threading.Event()
        self._client = paho.Client(paho.CallbackAPIVersion.VERSION2)
        self._client.on_message = self._on_message
        self._client.on_connect = lambda client, *_: client.subscribe("spBv1.0/plant/#", 2)
        self._client.on_subscribe = lambda *_: self._subscribed.set()
        self._client.reconnect_delay_set(0.1, 0.2)
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()
        assert self._subscribed.wait(20)

    def _on_message(self, client: Any, data: Any, message: Any) -> None:
        parts = message.topic.split("/")
        if parts[3] != self.node or parts[2].endswith("CMD"):
            return
        payload = self._pb.Payload()
        payload.ParseFromString(message.payload)
        device = parts[4] if len(parts) > 4 else ""
        self.messages.append(Received(parts[2], device, payload, message.qos, message.retain, message.payload))

    def of(self, kind: str, device: str = "") -> list[Received]:
        """Return the messages of a kind."""
        return [m for m in list(self.messages) if m.kind == kind and m.device == device]

    def say(self, *, online: bool, later_ms: int = 0) -> None:
        """Publish the state of this host, with a time that is `later_ms` after its beginning."""
        state = json.dumps({"online": online, "timestamp": self._began_ms + later_ms})
        self._client.publish(f"spBv1.0/STATE/{self._name}", state, qos=1, retain=True).wait_for_publish(10)

    def command(self, device: str = "", **metrics: Any) -> None:
        """Send NCMD, or DCMD to a device. The names of metrics have ``_`` for a space."""
        payload = self._pb.Payload()
        payload.timestamp = int(time.time() * 1000)
        for name, value in metrics.items():
            metric = payload.metrics.add()
            metric.name, metric.timestamp = name.replace("__", "/").replace("_", " "), payload.timestamp
            if isinstance(value, bool):
                metric.datatype, metric.boolean_value = 11, value
            elif isinstance(value, int):
                metric.datatype, metric.long_value = 4, value
            else:
                metric.datatype, metric.double_value = 10, value
        kind = f"DCMD/{self.node}/{device}" if device else f"NCMD/{self.node}"
        self._client.publish(f"spBv1.0/plant/{kind}", payload.SerializeToString()).wait_for_publish(10)

    def raw(self, topic: str, payload: bytes) -> None:
        """Publish any message."""
        self._client.publish(topic, payload, qos=1).wait_for_publish(10)

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def until(self, condition: Callable[[], Any], what: str, within_s: float = 40.0) -> Any:
        """Wait for a condition, and return its result."""
        end = time.monotonic() + within_s
        while not (found := condition()):
            seen = [(m.kind, m.device, m.payload.seq) for m in list(self.messages)]
            assert time.monotonic() < end, f"not within {within_s} s: {what}; {seen[-20:]}"
            time.sleep(0.02)
        return found


@contextmanager
def host(port: int, **names: str) -> Iterator[Host]:
    """A host application that disconnects at the end."""
    made = Host(port, **names)
    try:
        yield made
    finally:
        made.close()
