"""The processes whose knowledge a digital thread shares: bounded queues of events of the physical or the digital twin.

The shadow is built on these classes. This module must never depend on a connection, or on code that can send a command.
"""

from __future__ import annotations

from abc import ABC
from collections import deque
from typing import ClassVar

from fieldtwin.gateway.core.clock import NS_PER_MS, Clock
from fieldtwin.gateway.core.concurrency.events import EventHandler
from fieldtwin.gateway.core.errors import Bug
from fieldtwin.gateway.core.values import DATA, RESPONSE, STATUS, TagValue
from fieldtwin.gateway.store.event import Event, Kind, of_tag, stored

KNOWLEDGE = 10_000
"""The largest number of events that a process keeps until its thread connection collects them."""


class DigitalThreadProcess(ABC):  # noqa: B024  the schema has state and no operations
    """The paper's DigitalThreadProcess: shareable knowledge, in order, bounded. A full queue drops its oldest event and
    counts it (paper.md, ruling 2).
    """

    side: ClassVar[str] = ""

    def __init__(self, name: str, clock: Clock, capacity: int = KNOWLEDGE) -> None:
        if not self.side:
            raise Bug(
                "an abstract DigitalThreadProcess was made", expected="one of the physical or of the digital twin"
            )
        self.name = name
        self.knowledge: deque[Event] = deque(maxlen=capacity)
        self.dropped = 0
        self._clock = clock

    def share(self, kind: Kind, name: str, value: DATA | TagValue | str | int | float | None, t_ms: int = 0) -> Event:
        """Add an event to the knowledge to share: an unchanged payload, a tag with its quality, or a text of the process itself.

        `t_ms` is the time (UTC) at which the event occurred; by default now.
        """
        t_ms = t_ms or self._clock.utc_ns() // NS_PER_MS
        if isinstance(value, TagValue):
            event = of_tag(t_ms, name, value)._replace(kind=int(kind))
        else:
            event = stored(Event(0, t_ms, int(kind), name), value.data if isinstance(value, DATA) else value)
        if len(self.knowledge) == self.knowledge.maxlen:
            self.dropped += 1
        self.knowledge.append(event)
        return event

    def collect(self) -> list[Event]:
        """Remove and return all events to share, in order."""
        taken = list(self.knowledge)
        self.knowledge.clear()
        return taken


class PTDigitalThreadProcess(DigitalThreadProcess):
    """A process of the physical twin: the control logic, and the gateway with its values."""

    side = "physical"

    def put(self, name: str, value: TagValue) -> None:
        """Share a tag's new value (a subscriber of `TagTable`)."""
        self.share(Kind.VALUE, name, value)

    def respond(self, program: str, response: RESPONSE) -> None:
        """Share a message that the control logic sent to its transmitter: a STATUS, or a measurement whose payload stays
        unchanged.
        """
        self.share(Kind.STATE if isinstance(response, STATUS) else Kind.PAYLOAD, program, response)


class DTDigitalThreadProcess(DigitalThreadProcess):
    """A process of the digital twin: Monitor, Analyze, Plan, Execute or a database.

    It cannot command; the process that can is `fieldtwin.twin.thread.thread.Operator`.
    """

    side = "digital"


class ReceivingEnd(EventHandler):
    """A bounded queue of what arrives over a thread (paper.md, ruling 2).

    A shadow has no other part of a connection (paper.md, ruling 16): the sender that polls, acknowledges and requests missing
    events is created elsewhere.
    """

    def __init__(self, event: str, capacity: int = KNOWLEDGE) -> None:
        super().__init__(event)
        self.queue: deque[tuple[str, Event]] = deque(maxlen=capacity)
        self.dropped = 0

    def observe(self, origin: str, event: Event) -> None:
        """Append an event of an origin; a full queue drops its oldest event and counts it."""
        if len(self.queue) == self.queue.maxlen:
            self.dropped += 1
        self.queue.append((origin, event))

    def consume(self) -> tuple[str, Event]:
        """Remove and return the first event. The queue must not be empty."""
        if not self.queue:
            raise Bug("consume from an empty queue", where=self.event)
        return self.queue.popleft()
