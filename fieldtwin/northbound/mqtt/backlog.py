"""The samples that wait for the broker: a bounded queue for each device, from which the oldest samples are dropped first."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from fieldtwin.gateway.core.values import Quality, Reason, Scalar
from fieldtwin.northbound.mqtt.served_tags import ServedTag

SIZE = 64
"""The size of a sample with a number, in bytes, as the limit of the backlog counts it."""


@dataclass(slots=True, eq=False)
class Entry:
    """One sample of a tag, with its source time (UTC, ms). The value is None if the quality is bad."""

    tag: ServedTag
    value: Scalar | None
    quality: Quality
    reason: Reason
    t_ms: int
    number: int = 0
    """The position in the backlog, counted over all devices from 1; 0 for an entry that never waited."""
    sent: bool = False
    """Whether the broker has received it."""

    @property
    def size(self) -> int:
        """Return the size in bytes, as the limit of the backlog counts it."""
        return SIZE + (len(self.value) * 4 if isinstance(self.value, str | bytes) else 0)


class Backlog:
    """The samples that the broker has not received yet, at most `max_samples` and `max_bytes`."""

    def __init__(self, max_samples: int, max_bytes: int) -> None:
        self._max_samples, self._max_bytes = max_samples, max_bytes
        self._queues: dict[str, deque[Entry]] = {}
        self._bytes = 0
        self.waiting = 0
        self.last = 0
        """The number of the latest entry."""
        self.dropped = 0
        """How many entries were dropped because the backlog was full."""

    def add(self, entry: Entry) -> None:
        """Append an entry. If the backlog is full, drop the oldest ones."""
        self.last += 1
        entry.number = self.last
        self._queues.setdefault(entry.tag.device, deque()).append(entry)
        self.waiting += 1
        self._bytes += entry.size
        while self.waiting > self._max_samples or self._bytes > self._max_bytes:
            oldest = min((queue for queue in self._queues.values() if queue), key=lambda queue: queue[0].number)
            self._pop(oldest)
            self.dropped += 1

    def _pop(self, queue: deque[Entry]) -> None:
        entry = queue.popleft()
        self.waiting -= 1
        self._bytes -= entry.size

    def first(self, device: str, count: int) -> list[Entry]:
        """Return the oldest entries of a device that were not sent, at most `count`. They stay in the backlog."""
        queue = self._queues.get(device, deque())
        while queue and queue[0].sent:
            self._pop(queue)
        found: list[Entry] = []
        for entry in queue:
            if len(found) == count:
                break
            if not entry.sent:
                found.append(entry)
        return found

    def clear(self) -> None:
        """Drop all entries without counting them."""
        self._queues.clear()
        self.waiting = self._bytes = 0
