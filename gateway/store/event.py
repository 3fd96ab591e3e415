"""Events, of which the stored knowledge consists, and the interface of the store, independent of the database.

An event is a value with its quality, a command, a refusal, a state, a verdict, a payload as received, or a record that
some events were lost. Events of one origin are numbered from 1 without gaps: two stores hold the same knowledge of an
origin if they hold the same numbers. This module uses no database and no clock.
"""

from __future__ import annotations

import math
from collections.abc import AsyncIterator, Iterable, Sequence
from enum import IntEnum
from typing import NamedTuple, Protocol

from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.gateway.core.values import Quality, Reason, Scalar, TagValue

INT_MIN, INT_MAX = -(1 << 63), (1 << 63) - 1
MAX_VALUE_BYTES = 4096
"""A text or a payload is cut off at this length, and is then uncertain (`Reason.NOT_EXACT`)."""


class Kind(IntEnum):
    """The kind of an event. The numbers are stored and sent, so they never change; the format has room for 7 kinds."""

    VALUE = 0
    """`name` is a tag; `value` is in engineering units, None if it has none."""
    COMMAND = 1
    """`value` is the payload of a command (bytes) as it was sent; `name` is its sender."""
    REFUSAL = 2
    """`value` is the reason why a command or plan was refused; `name` is the part of the system that refused it."""
    STATE = 3
    """`value` is a STATUS: state and period (bytes, `fieldtwin.twin.model.status`); `name` is the owner of the state
    machine."""
    VERDICT = 4
    """`value` is the result of an analysis; `name` is the tag or object that was analysed."""
    PAYLOAD = 5
    """`value` is a RESPONSE as it was received (bytes); `name` is the program or device that sent it."""
    LOSS = 6
    """Events were lost: `value` is the number of events that were never stored, and `name` is the reason."""


Value = None | int | float | str | bytes


class Event(NamedTuple):
    """One event of an origin.

    `sequence` is 0 until the event is in a log. `t_ms` is UTC in milliseconds. `Kind` describes the other fields.
    """

    sequence: int
    t_ms: int
    kind: int
    name: str
    value: Value = None
    quality: int = 0
    reason: int = 0


def of_tag(t_ms: int, name: str, value: TagValue) -> Event:
    """Return a tag's value as an event. NaN, which databases cannot store, becomes None with a reason."""
    quality, reason = value.quality, value.reason
    if isinstance(value.value, float) and math.isnan(value.value) and quality < Quality.BAD:
        quality, reason = Quality.BAD, Reason.NOT_A_NUMBER
    return stored(Event(0, t_ms, Kind.VALUE, name, None, int(quality), int(reason)), value.value)


def stored(event: Event, value: Scalar | None) -> Event:
    """Return `event` with `value` in the form of `plain`. If that form differs from `value`, the quality becomes uncertain
    unless it is bad.
    """
    kept = plain(value)
    if value is not None and kept is not None and kept != value and event.quality < Quality.UNCERTAIN:
        event = event._replace(quality=int(Quality.UNCERTAIN), reason=int(Reason.NOT_EXACT))
    return event._replace(value=kept)


def plain(value: Scalar | None) -> Value:
    """Return `value` as stores and digital threads hold it: 0 or 1 for a bool, None for NaN, a float for more than 64 bits."""
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, int):
        return value if INT_MIN <= value <= INT_MAX else float(value)
    if isinstance(value, float):
        return None if math.isnan(value) else value
    if isinstance(value, str):
        text = value.replace("\0", "")  # PostgreSQL's text type cannot hold NUL
        return text.encode(errors="replace")[:MAX_VALUE_BYTES].decode(errors="ignore")
    return value[:MAX_VALUE_BYTES] if value is not None else None


class StoreFull(Unreachable):
    """The store cannot take more events: the disk is full, or the store has reached its limit. The stored events are intact."""


class KnowledgeStore(Protocol):
    """A store for events of several origins. Every method may raise `Unreachable` (`StoreFull` if there is no room).

    When a method has returned, its change is permanent: it survives a killed process and a power failure.
    """

    async def own(self, name: str, *, system: str, prototype: bool, log: str) -> str:
        """Return the origin under which this process writes events of `system`: the existing one, or a new one named
        ``name:log``.

        `prototype` is part of the identity of an origin (paper.md, ruling 15). `log` distinguishes a new store from an earlier
        store of the same name.
        """
        ...

    async def origins(self, system: str = "") -> dict[str, bool]:
        """Return every origin in the store, and whether its events come from a prototype.

        With `system`, return only the origins of that system, and those for which an older store does not record the system."""
        ...

    async def append(self, origin: str, events: Sequence[Event]) -> int:
        """Number `events`, store all of them or none, and return the last number.

        Only the writer of this origin's log may call this.
        """
        ...

    async def keep(self, origin: str, events: Sequence[Event], *, system: str = "", prototype: bool = False) -> int:
        """Store numbered events from the log of another writer in `system`; return the number of new events.

        A repeated event is stored once.
        """
        ...

    async def span(self, origin: str) -> tuple[int, int]:
        """Return the numbers of the first and the last stored event of an origin; (1, 0) if there are none."""
        ...

    async def gaps(self, origin: str) -> list[tuple[int, int]]:
        """Return the ranges (first, last) of missing numbers up to the last event, except those of events that are known to be
        lost.
        """
        ...

    async def read(self, origin: str, first: int, limit: int) -> list[Event]:
        """Return at most `limit` events from number `first` on, in order."""
        ...

    def replay(self, origin: str, since_ms: int, until_ms: int) -> AsyncIterator[list[Event]]:
        """Yield, in blocks and in order, all events of the time range (UTC in ms)."""
        ...

    async def note_lost(self, origin: str, first: int, last: int) -> None:
        """Record that the writer no longer has events `first` to `last`, so that they do not count as gaps."""
        ...

    async def forget(self, origin: str, through: int) -> int:
        """Delete an origin's events up to and including number `through`; return how many were deleted."""
        ...

    def room_bytes(self) -> int | None:
        """Return the number of free bytes, or None if it is unknown."""
        ...

    async def aclose(self) -> None:
        """Close the connection to the database. The stored events remain."""
        ...


def merged(ranges: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the ranges (first, last) in order, with adjacent and overlapping ranges joined."""
    out: list[tuple[int, int]] = []
    for first, last in sorted(ranges):
        if out and first <= out[-1][1] + 1:
            out[-1] = (out[-1][0], max(out[-1][1], last))
        else:
            out.append((first, last))
    return out


def without(ranges: Iterable[tuple[int, int]], holes: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the parts of the ranges (first, last) that are not in `holes`, in order."""
    out = merged(ranges)
    for hole_first, hole_last in merged(holes):
        parts: list[tuple[int, int]] = []
        for first, last in out:
            if hole_last < first or hole_first > last:
                parts.append((first, last))
                continue
            if first < hole_first:
                parts.append((first, hole_first - 1))
            if last > hole_last:
                parts.append((hole_last + 1, last))
        out = parts
    return out
