"""The status of one end of a digital thread, for a run's summary and on the control channel of the plant's end.

The fields are the keys of the JSON object.
"""

from __future__ import annotations

import msgspec


class ReceivedLog(msgspec.Struct, frozen=True, kw_only=True):
    """The status of a log that this end receives."""

    through: int
    """Number of the last event up to which every event is stored, or recorded as lost."""
    lost: int
    """Events that the sender's store no longer had, since this process began."""


class ThreadStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The status of one end of a thread."""

    carrier: str
    connected: bool
    since_ms: int | None
    """The time of the last connection or disconnection (UTC); None before the thread began."""
    links: int
    """Number of links that were opened so far."""
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
    """The reason why no events arrive although the link is open; empty if events arrive."""
    trouble: str
    """The reason why events cannot be sent or stored; empty if they can."""


class PlantThreadStatus(ThreadStatus, frozen=True, kw_only=True):
    """The process at the plant's end: the answer to `get`."""

    place: str
    """The URL at which it listens."""
    written: int
    dropped: int
    """Number of events that could not be written into its log."""
    store_trouble: str
    """The reason why its log cannot be stored; empty if it is stored."""
    commands_taken: int
    commands_refused: int
