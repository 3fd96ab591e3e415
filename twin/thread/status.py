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
    """Number of events that the sender's store no longer had, since this process began."""


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
    """Number up to which the other end has acknowledged every event; None before the first link."""
    waiting: int
    """Number of events that the other end has not acknowledged."""
    resent: int
    duplicates: int
    received: dict[str, ReceivedLog]
    """The logs of the other end, by their origin."""
    silent: str
    """The reason why no events arrive although the link is open; empty if events arrive."""
    trouble: str
    """The reason why events cannot be sent or stored; empty if they can."""


class PlantThreadStatus(ThreadStatus, frozen=True, kw_only=True):
    """The status of the process at the plant's end: its answer to `get`."""

    place: str
    """The URL of the thread, with the port on which the process listens, if it listens."""
    written: int
    dropped: int
    """Number of events that could not be written into the log of the plant."""
    store_trouble: str
    """The reason why the log of the plant cannot be stored; empty if it can."""
    commands_taken: int
    commands_refused: int
