"""The values that an emulated device held in its registers or objects: every raw value of every tag, in order.

A prototype run (the gateway with emulated devices) is checked against this journal: it must contain every value that the
gateway published as good. A raw value is stored as the bytes that the device would send. The journal is bounded: the oldest
entries are dropped and counted, so a checker must fetch entries often enough.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import msgspec

CAPACITY = 200_000
SHARED, LEAST = 1_000_000, 1_000
"""The largest number of entries of all devices in a process together, about 60 bytes each, and the minimum for one device."""


class DeviceValue(msgspec.Struct, frozen=True, gc=False):
    """An entry of the journal: from `t_ns` (the emulator's monotonic time) on, `tag` had the value `raw`."""

    number: int
    tag: str
    raw: bytes
    t_ns: int


class DeviceValueLog:
    """One device's journal. Consecutive equal values are one entry.

    Entries are stored in columns, and numbered by position, because a thousand devices in one process hold a million
    entries.
    """

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._tags: deque[str] = deque(maxlen=capacity)
        self._raws: deque[bytes] = deque(maxlen=capacity)
        self._times: deque[int] = deque(maxlen=capacity)
        self._last: dict[str, bytes] = {}
        self._watched: dict[str, Callable[[bytes, int], None]] = {}
        self.number = 0
        """The number of the latest entry; numbering starts at 1."""

    def keep(self, capacity: int) -> None:
        """Keep at most `capacity` entries from now on. The oldest entries are dropped."""
        self._tags = deque(self._tags, capacity)
        self._raws = deque(self._raws, capacity)
        self._times = deque(self._times, capacity)

    @property
    def dropped(self) -> int:
        """Return the number of entries that were dropped."""
        return self.number - len(self._tags)

    def note(self, tag: str, raw: bytes, now_ns: int) -> None:
        """Record that `tag` has the value `raw` from now on."""
        if self._last.get(tag) == raw:
            return
        self._last[tag] = raw
        if tag in self._watched:
            self._watched[tag](raw, now_ns)
        self.number += 1
        self._tags.append(tag)
        self._raws.append(raw)
        self._times.append(now_ns)

    def watch(self, tag: str, changed: Callable[[bytes, int], None]) -> None:
        """Call ``changed(raw, t_ns)`` each time that the value of `tag` changes, and now if it already has one.

        One watcher per tag. It may not write to the device.
        """
        self._watched[tag] = changed
        if tag in self._last:
            changed(self._last[tag], 0)

    def since(self, number: int) -> list[DeviceValue]:
        """Return the entries after entry `number` that are still kept."""
        count = min(self.number - number, len(self._tags))
        numbers = range(self.number, self.number - count, -1)
        newest = zip(numbers, reversed(self._tags), reversed(self._raws), reversed(self._times), strict=False)
        return [DeviceValue(*entry) for entry in newest][::-1]


def share_of(devices: int) -> int:
    """Return how many entries each device may keep if a process has `devices` devices."""
    return min(CAPACITY, max(LEAST, SHARED // max(1, devices)))
