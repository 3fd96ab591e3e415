"""The status of one end of a digital thread, for a run's summary and on the control channel of the plant's end.

The fields are the keys of the JSON object.
"""

from __future__ import annotations

import msgspec


class ReceivedLog(msgspec.Struct, frozen=True, kw_only=True):
    """A log that this end receives."""

    through: int
    """The last event up to which everything is stored, or recorded as lost."""
    lost: int
    """Events that the sender's store no longer had, since this process began."""


class ThreadStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One end of a thread."""

    carrier: str
    connected: bool
    since_ms: int | None
    """Since when it is connected, or not (UTC); None before the thread began."""
    links: int
    """How many links were opened so far."""
    origin: str
    sent_through: int | None
    """The last event that the other end has acknowledged; None before the first link."""
    waiting: int
    """Events that the other end has not acknowledged."""
    resent: int
    duplicates: int
    received: dict[str, ReceivedLog]
    """The logs of the other end, by their origin."""
    silent: str
    """Why nothing arrives although the link is open; empty if data arrive."""
    trouble: str
    """Why events cannot be sent or stored; empty if they can."""


class PlantThreadStatus(ThreadStatus, frozen=True, kw_only=True):
    """The process at the plant's end: the answer to `get`."""

    place: str
    """The URL at which it listens."""
    written: int
    dropped: int
    """Events that its log lost."""
    store_trouble: str
    """Why its log cannot be stored; empty if it is stored."""
    commands_taken: int
    commands_refused: int
