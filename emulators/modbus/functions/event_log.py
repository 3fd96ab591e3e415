"""The communication event log of a unit, which function 0Ch returns (AP 6.10).

The log holds one byte per event, the newest first, at most 64. The standard requires that older events are dropped. This module
performs no I/O.
"""

from __future__ import annotations

from collections import deque

MAX_EVENTS = 64

RESTARTED = 0x00
ENTERED_LISTEN_ONLY = 0x04
RECEIVED, DAMAGED, WHILE_LISTENING, BROADCAST = 0x80, 0x02, 0x20, 0x40
"""`RECEIVED`: a message arrived; the other values are flags of such an event."""
SENT = 0x40
_SENT_FLAGS = {1: 0x01, 2: 0x01, 3: 0x01, 4: 0x02, 5: 0x04, 6: 0x04, 7: 0x08}
"""Exception code -> flag of a send event: read exception, abort, busy, program NAK."""


class CommEventLog:
    """The events of a unit as bytes. `content` is what function 0Ch returns."""

    def __init__(self) -> None:
        self._events: deque[int] = deque(maxlen=MAX_EVENTS)

    @property
    def content(self) -> bytes:
        """Return the event bytes, the newest first."""
        return bytes(self._events)

    def note(self, event: int) -> None:
        """Add an event as the newest. If there are more than 64 events, the oldest is removed."""
        self._events.appendleft(event)

    def note_received(self, *, listening: bool = False, broadcast: bool = False, damaged: bool = False) -> None:
        """Record that a message arrived. Call it before the message is executed."""
        event = RECEIVED
        if listening or broadcast or damaged:
            event |= listening * WHILE_LISTENING | broadcast * BROADCAST | damaged * DAMAGED
        self._events.appendleft(event)

    def note_sent(self, response: bytes) -> None:
        """Record that a response was sent, with the kind of exception if it is an exception response."""
        self._events.appendleft(SENT if response[0] < 0x80 else SENT | _SENT_FLAGS.get(response[1], 0))

    def clear(self) -> None:
        """Remove all events."""
        self._events.clear()
