"""Messages in JSON: one topic for each tag, by template, and a topic that says whether the server is connected.

    {"value": 1.5, "quality": "good", "unit": "m", "time": "2026-01-31T12:00:00.000Z"}

A value that is not good has a `reason`, and a bad value is null. A value with a name in the profile has this name as `text`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from datetime import UTC, datetime
from math import isfinite
from typing import Any

from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.northbound.mqtt.backlog import Backlog, Entry
from fieldtwin.northbound.mqtt.publication import MOST_ENTRIES, Batch, Publication, WriteRequest
from fieldtwin.northbound.mqtt.served_tags import ServedTag
from fieldtwin.twin.site.servers.serving_mqtt import JsonConfig
from fieldtwin.twin.thread.mqtt.message import MqttMessage

ONLINE, OFFLINE = b"online", b"offline"


class JsonPublication(Publication):
    """The messages of a server in JSON. `prefix` is put before every topic, for a prototype."""

    def __init__(
        self,
        config: JsonConfig,
        system: str,
        tags: Iterable[ServedTag],
        backlog: Backlog,
        now_ms: int,
        prefix: str = "",
    ) -> None:
        super().__init__(tags, backlog, now_ms, interval=config.interval)
        self._config = config
        self._status = prefix + config.status.format(system=system)
        self._topics = {
            tag.name: prefix + config.topic.format(system=system, device=tag.owner, tag=tag.local)
            for tag in self.tags.values()
        }
        self._devices = list(dict.fromkeys(tag.device for tag in self.tags.values()))
        self._needs_status = True
        self._began = 0
        """The number of the last entry before this session."""

    @property
    def place(self) -> str:
        """Return the topic of the status."""
        return f"JSON {self._status}"

    def begin(self, bd_seq: int, now_ms: int) -> MqttMessage:
        self._needs_all = self._needs_status = True
        self._began = self.backlog.last
        if not self._config.history:
            self.backlog.clear()
        return MqttMessage(self._status, OFFLINE, qos=1, retain=True)

    def next_batch(self, now_ms: int) -> Batch | None:
        """Return the status first, then the samples that wait, then once in a session the latest sample of each tag."""
        if self._needs_status:
            self._needs_status = False
            return Batch([MqttMessage(self._status, ONLINE, qos=1, retain=True)])
        for device in self._devices:
            if entries := self.backlog.first(device, MOST_ENTRIES):
                messages = [self._message(entry, historical=entry.number <= self._began) for entry in entries]
                return Batch(messages, entries)
        if self._needs_all or self.has_lost:
            self._all_published()
            self.counters["births"] += 1
            entries = list(self.latest.values())
            return Batch([self._message(entry) for entry in entries], entries)
        return None

    def _message(self, entry: Entry, *, historical: bool = False) -> MqttMessage:
        payload = json.dumps(contents(entry, historical=historical), allow_nan=False)
        return MqttMessage(self._topics[entry.tag.name], payload.encode(), self._config.qos, self._config.retain)

    def receive(self, topic: str, payload: bytes) -> list[WriteRequest]:
        """Return nothing, because this server subscribes to no topic."""
        return []


def contents(entry: Entry, *, historical: bool = False) -> dict[str, Any]:
    """Return the message of a sample."""
    value, quality, reason = entry.value, entry.quality, entry.reason
    if isinstance(value, float) and not isfinite(value):  # JSON has no such number
        value, quality, reason = None, Quality.BAD, Reason.NOT_A_NUMBER
    found: dict[str, Any] = {"value": value.hex() if isinstance(value, bytes) else value, "quality": str(quality)}
    if quality is not Quality.GOOD:
        found["reason"] = str(reason)
    if word := entry.tag.word(value):
        found["text"] = word
    if entry.tag.unit:
        found["unit"] = entry.tag.unit
    found["time"] = _time(entry.t_ms)
    if historical:
        found["historical"] = True
    return found


def _time(t_ms: int) -> str:
    """Return a time as ISO 8601 in UTC, to the millisecond."""
    return datetime.fromtimestamp(t_ms / 1000, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
