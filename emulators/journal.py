"""What an emulated device really held: every raw value of every tag, in order. The oracle of a prototype run.

Whatever the gateway published as good must be found here (bytes as the device would send them). Bounded: the oldest entries
fall off and are counted; whoever checks fetches often enough.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import msgspec

CAPACITY = 200_000
SHARED, LEAST = 1_000_000, 1_000
"""Entries of all devices of a process together, some 60 bytes each; and what a device has of them at least."""


class Held(msgspec.Struct, frozen=True, gc=False):
    """From `t_ns` (the emulator's monotonic time) on, `tag` was `raw`."""

    number: int
    tag: str
    raw: bytes
    t_ns: int


class HeldJournal:
    """One device's journal. Equal values in a row are one entry. Kept as columns, and numbered by where an entry stands: a
    thousand devices in one process hold a million entries."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._tags: deque[str] = deque(maxlen=capacity)
        self._raws: deque[bytes] = deque(maxlen=capacity)
        self._times: deque[int] = deque(maxlen=capacity)
        self._last: dict[str, bytes] = {}
        self._watched: dict[str, Callable[[bytes, int], None]] = {}
        self.number = 0
        """Of the latest entry; they count from 1."""

    def keep(self, capacity: int) -> None:
        """Keep at most `capacity` entries from now on; the newest stay."""
        self._tags = deque(self._tags, capacity)
        self._raws = deque(self._raws, capacity)
        self._times = deque(self._times, capacity)

    @property
    def dropped(self) -> int:
        """Entries that fell off."""
        return self.number - len(self._tags)

    def note(self, tag: str, raw: bytes, now_ns: int) -> None:
        """`tag` is `raw` from now on."""
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
        """Call ``changed(raw, t_ns)`` each time that `tag` becomes something else, and now where it is something already.

        One watcher a tag. It may not write to the device.
        """
        self._watched[tag] = changed
        if tag in self._last:
            changed(self._last[tag], 0)

    def since(self, number: int) -> list[Held]:
        """The entries after entry `number`, as far as they are kept."""
        count = min(self.number - number, len(self._tags))
        numbers = range(self.number, self.number - count, -1)
        newest = zip(numbers, reversed(self._tags), reversed(self._raws), reversed(self._times), strict=False)
        return [Held(*entry) for entry in newest][::-1]


def share_of(devices: int) -> int:
    """How many entries each of so many devices in a process keeps."""
    return min(CAPACITY, max(LEAST, SHARED // max(1, devices)))
