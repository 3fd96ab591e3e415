"""What an emulated device really held: every raw value of every tag, in order. The oracle of a prototype run.

Whatever the gateway published as good must be found here (bytes as the device would send them). Bounded: the oldest entries
fall off and are counted; whoever checks fetches often enough.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

CAPACITY = 200_000


@dataclass(frozen=True, slots=True)
class Held:
    """From `t_ns` (the emulator's monotonic time) on, `tag` was `raw`."""

    number: int
    tag: str
    raw: bytes
    t_ns: int


class HeldJournal:
    """One device's journal. Equal values in a row are one entry."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._entries: deque[Held] = deque(maxlen=capacity)
        self._last: dict[str, bytes] = {}
        self.number = 0
        self.dropped = 0

    def note(self, tag: str, raw: bytes, now_ns: int) -> None:
        """`tag` is `raw` from now on."""
        if self._last.get(tag) == raw:
            return
        self._last[tag] = raw
        self.number += 1
        self.dropped += len(self._entries) == self._entries.maxlen
        self._entries.append(Held(self.number, tag, raw, now_ns))

    def since(self, number: int) -> list[Held]:
        """The entries after entry `number`, as far as they are kept."""
        newer: list[Held] = []
        for entry in reversed(self._entries):
            if entry.number <= number:
                break
            newer.append(entry)
        return newer[::-1]
