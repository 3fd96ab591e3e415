"""The messages of an MQTT server without a connection: the latest samples, the samples that wait, and what is published next.

`SparkplugPublication` and `JsonPublication` are the two formats. This module and theirs know neither sockets nor clocks.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field

from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.northbound.data_types import fitted
from fieldtwin.northbound.mqtt.backlog import Backlog, Entry
from fieldtwin.northbound.mqtt.served_tags import ServedTag
from fieldtwin.northbound.samples import Sample
from fieldtwin.twin.thread.mqtt.message import MqttMessage

UNKNOWN = "unknown"
MOST_ENTRIES = 250
"""The largest number of samples in one batch."""


@dataclass(frozen=True)
class Batch:
    """Messages to publish in order, and the entries that count as sent when the broker has received them."""

    messages: list[MqttMessage]
    entries: list[Entry] = field(default_factory=list)


@dataclass(frozen=True)
class WriteRequest:
    """A client's request to write a tag. `tag` is `UNKNOWN` if the request names no tag."""

    tag: str
    value: float | None
    refusal: str = ""
    """Why the server refuses it; empty if the gateway shall decide."""


class Publication(ABC):
    """The messages of one server. `begin` starts a session; then `next_batch` returns what is to be published.

    With `interval` every tag is noted at each look; otherwise only a tag whose value, quality or reason has changed.
    """

    subscriptions: tuple[str, ...] = ()
    """The topics that this server subscribes to."""

    def __init__(self, tags: Iterable[ServedTag], backlog: Backlog, now_ms: int, *, interval: bool = False) -> None:
        self.tags = {tag.name: tag for tag in tags}
        self.backlog = backlog
        self.latest = {
            name: Entry(tag, None, Quality.BAD, Reason.NEVER_READ, now_ms) for name, tag in self.tags.items()
        }
        """The latest entry of each tag."""
        self.counters = {"samples": 0, "sent": 0, "births": 0, "commands_refused": 0}
        self._interval = interval
        self._needs_all = True
        """Whether the latest samples of all tags have to be published, because the session has begun or samples were lost."""
        self._dropped = 0

    def note(self, name: str, sample: Sample, t_ms: int) -> None:
        """Take over a sample with its source time (UTC, ms)."""
        before, tag = self.latest[name], self.tags[name]
        quality, reason = sample.quality, sample.reason
        value = None if sample.value is None else fitted(sample.value, tag.data_type)
        if value is None and quality is not Quality.BAD:  # the data type cannot hold the value
            quality, reason = Quality.BAD, Reason.OUT_OF_RANGE
        entry = self.latest[name] = Entry(tag, value, quality, reason, t_ms)
        changed = (value, quality, reason) != (before.value, before.quality, before.reason)
        if changed and not self._interval:
            self._queue(entry)

    def end_look(self) -> None:
        """Note that all samples of a look at the process image were noted."""
        if self._interval:
            for name, entry in self.latest.items():
                again = Entry(entry.tag, entry.value, entry.quality, entry.reason, entry.t_ms)
                self.latest[name] = again
                self._queue(again)

    def _queue(self, entry: Entry) -> None:
        self.counters["samples"] += 1
        self.backlog.add(entry)

    @property
    def has_lost(self) -> bool:
        """Return whether the backlog has dropped samples since all latest samples were published."""
        return self.backlog.dropped > self._dropped

    def _all_published(self) -> None:
        self._needs_all = False
        self._dropped = self.backlog.dropped

    def sent(self, batch: Batch) -> None:
        """Note that the broker has received a batch."""
        for entry in batch.entries:
            if not entry.sent:
                entry.sent = True
                self.counters["sent"] += bool(entry.number)

    @property
    def is_ready(self) -> bool:
        """Return whether messages may be published in this session."""
        return True

    @property
    def must_end(self) -> bool:
        """Return whether the session has to end now, because the primary host application is offline."""
        return False

    @abstractmethod
    def begin(self, bd_seq: int, now_ms: int) -> MqttMessage:
        """Begin a session, and return the message that the broker publishes when it is lost. `bd_seq` numbers the session."""

    @abstractmethod
    def next_batch(self, now_ms: int) -> Batch | None:
        """Return the next messages to publish; None if nothing waits."""

    @abstractmethod
    def receive(self, topic: str, payload: bytes) -> list[WriteRequest]:
        """Take a message of a subscribed topic. Raises `Desync` for a damaged one."""

    @property
    @abstractmethod
    def place(self) -> str:
        """Return a short description of the topics, for the status."""
