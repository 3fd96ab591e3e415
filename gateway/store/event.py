"""What knowledge is made of: events, each with its time, and the store that keeps them, whatever database it is.

An event is a value with its quality, a command, a refusal, a state, a verdict, a payload as it was, or the admission that some
were lost. Events of one origin are numbered from 1 without holes: two stores hold the same knowledge of an origin when they
hold the same numbers. Pure: no database and no clock here.
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
"""A text or a payload that is longer is no value of a tag."""


class Kind(IntEnum):
    """What an event tells. The numbers are stored and sent: they never change, and there is room for 7."""

    VALUE = 0
    """`name` is a tag; `value` in engineering units, None where it has none."""
    COMMAND = 1
    """`value` is the payload of a command (bytes) as it was sent; `name` who sent it."""
    REFUSAL = 2
    """`value` says why a command or plan was refused; `name` by whom."""
    STATE = 3
    """`value` is a STATUS, state and period (bytes, `fieldtwin.twin.model.status`); `name` is whose state machine it is."""
    VERDICT = 4
    """`value` is what an analysis found; `name` of what."""
    PAYLOAD = 5
    """`value` is a RESPONSE as it was received (bytes); `name` of which program or device."""
    LOSS = 6
    """`value` says how many events were never kept; `name` why."""


Value = None | int | float | str | bytes


class Event(NamedTuple):
    """One event of an origin. `sequence` is 0 until it is in a log; `t_ms` is UTC in milliseconds; the rest as `Kind` says."""

    sequence: int
    t_ms: int
    kind: int
    name: str
    value: Value = None
    quality: int = 0
    reason: int = 0


def of_tag(t_ms: int, name: str, value: TagValue) -> Event:
    """A tag's value as an event. What a database cannot hold exactly is not made up: NaN is no value, with its reason."""
    kept, quality, reason = plain(value.value), value.quality, value.reason
    if isinstance(value.value, float) and math.isnan(value.value) and quality < Quality.BAD:
        quality, reason = Quality.BAD, Reason.NOT_A_NUMBER
    return Event(0, t_ms, Kind.VALUE, name, kept, int(quality), int(reason))


def plain(value: Scalar | None) -> Value:
    """`value` as stores and threads keep it: 0 and 1 for a bool, None for NaN, a float for an integer beyond 64 bits."""
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, int):
        return value if INT_MIN <= value <= INT_MAX else float(value)
    if isinstance(value, float):
        return None if math.isnan(value) else value
    if isinstance(value, str):
        text = value.replace("\0", "")  # PostgreSQL's text has no NUL
        return text.encode(errors="replace")[:MAX_VALUE_BYTES].decode(errors="ignore")
    return value[:MAX_VALUE_BYTES] if value is not None else None


class StoreFull(Unreachable):
    """There is no room for more: the disk is full, or the store has reached its bound. Nothing that it holds is harmed."""


class KnowledgeStore(Protocol):
    """Keeps events of several origins. Every method may raise `Unreachable` (`StoreFull` where room is what lacks).

    What a method returned from is kept: through a killed process and a lost power supply.
    """

    async def own(self, name: str, *, system: str, prototype: bool, log: str) -> str:
        """The origin under which this side of `system` writes: the one it has already, else ``name:log``.

        `prototype` is part of what it is (SPEC ruling 15). `log` tells a new store from one that was there before.
        """
        ...

    async def origins(self, system: str = "") -> dict[str, bool]:
        """Every origin in the store, and whether its events come from a prototype. With `system`: those of it, and those of
        which an older store does not say whose they are."""
        ...

    async def append(self, origin: str, events: Sequence[Event]) -> int:
        """Number `events` and keep all of them or none; the last number. For the one who writes this origin's log."""
        ...

    async def keep(self, origin: str, events: Sequence[Event], *, system: str = "", prototype: bool = False) -> int:
        """Keep numbered events of somebody else's log, of `system`; how many were new. The same event twice is one."""
        ...

    async def span(self, origin: str) -> tuple[int, int]:
        """First and last number that there ever was of an origin and is not forgotten; (1, 0) where there is none."""
        ...

    async def gaps(self, origin: str) -> list[tuple[int, int]]:
        """Ranges of numbers up to the last that are missing, first and last of each; without those known to be lost."""
        ...

    async def read(self, origin: str, first: int, limit: int) -> list[Event]:
        """At most `limit` events from number `first` on, in order."""
        ...

    def replay(self, origin: str, since_ms: int, until_ms: int) -> AsyncIterator[list[Event]]:
        """All events of a time, in order, in blocks."""
        ...

    async def note_lost(self, origin: str, first: int, last: int) -> None:
        """Its writer has these no more: they are gone, and gaps no longer."""
        ...

    async def forget(self, origin: str, through: int) -> int:
        """Drop an origin's events up to a number; how many there were."""
        ...

    def room_bytes(self) -> int | None:
        """How much more fits, as far as can be told; None where it cannot."""
        ...

    async def aclose(self) -> None:
        """Close; the store stays."""
        ...


def merged(ranges: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """Ranges in order, those that touch or overlap as one."""
    out: list[tuple[int, int]] = []
    for first, last in sorted(ranges):
        if out and first <= out[-1][1] + 1:
            out[-1] = (out[-1][0], max(out[-1][1], last))
        else:
            out.append((first, last))
    return out


def without(ranges: Iterable[tuple[int, int]], holes: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """`ranges` less what is in `holes`, in order."""
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
