"""The values of one tag or variable over the time of a trace, in columns of 18 bytes for each event."""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from typing import Any, NamedTuple

MOST_KINDS = 0xFFFF
EXACT = 1 << 53
"""Integers below this limit are represented exactly as floating-point numbers."""


class Kind(NamedTuple):
    """The properties that many values share: their type (see `encoded`), quality and reason."""

    type: str
    quality: str
    reason: str


class Kinds:
    """A table that gives each kind of a trace a small number. After `MOST_KINDS` kinds, a further one raises `ValueError`."""

    def __init__(self) -> None:
        self._kinds: list[Kind] = []
        self._numbers: dict[Kind, int] = {}

    def number(self, kind: Kind) -> int:
        found = self._numbers.get(kind)
        if found is None:
            if len(self._kinds) == MOST_KINDS:
                raise ValueError("too many different qualities and reasons")
            found = self._numbers[kind] = len(self._kinds)
            self._kinds.append(kind)
        return found

    def __getitem__(self, number: int) -> Kind:
        return self._kinds[number]


def encoded(value: Any, at: int) -> tuple[str, float]:
    """Return type and number of a value. With type t, the number is `at`, the position of its line in the file.

    The types are b (boolean), i (whole number), f (number), n (no value) and t (text or anything else, which stays in the file).
    """
    if value is None:
        return "n", 0.0
    if isinstance(value, bool):
        return "b", float(value)
    if isinstance(value, int):
        return ("i", float(value)) if -EXACT < value < EXACT else ("t", float(at))
    return ("f", value) if isinstance(value, float) else ("t", float(at))


class Series:
    """Times in ns, values and kinds, ordered by time. Positions count from 0."""

    __slots__ = ("kinds", "times", "values")

    def __init__(self) -> None:
        self.times, self.values, self.kinds = array("q"), array("d"), array("H")

    def __len__(self) -> int:
        return len(self.times)

    def add(self, t_ns: int, value: float, kind: int) -> None:
        """Add an event. An event that is older than the latest is inserted in order of time."""
        if not self.times or t_ns >= self.times[-1]:
            self.times.append(t_ns)
            self.values.append(value)
            self.kinds.append(kind)
            return
        at = bisect_right(self.times, t_ns)
        self.times.insert(at, t_ns)
        self.values.insert(at, value)
        self.kinds.insert(at, kind)

    def last_at(self, t_ns: int) -> int:
        """Return the position of the last event at or before an instant, -1 if all events are later."""
        return bisect_right(self.times, t_ns) - 1

    def first_from(self, t_ns: int) -> int:
        """Return the position of the first event at or after an instant."""
        return bisect_left(self.times, t_ns)
