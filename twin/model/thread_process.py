"""The processes whose knowledge a digital thread shares: bounded queues of events, of the physical twin or of the digital one.

What a shadow is made of stands on this. It must never know a connection, nor anything that could send a command.
"""

from __future__ import annotations

from abc import ABC
from collections import deque
from typing import ClassVar

from fieldtwin.gateway.core.clock import NS_PER_MS, Clock
from fieldtwin.gateway.core.errors import Bug
from fieldtwin.gateway.core.events import EventHandler
from fieldtwin.gateway.core.values import DATA, RESPONSE, STATUS, TagValue
from fieldtwin.gateway.store.event import Event, Kind, of_tag, plain

KNOWLEDGE = 10_000
"""Events that a process keeps to be shared."""


class DigitalThreadProcess(ABC):  # noqa: B024  the schema has state and no operations
    """SPEC row DigitalThreadProcess: shareable knowledge, in order, bounded; a full one drops its oldest, counted (ruling 2)."""

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
        """Add to what is to be shared: a payload as it is, a tag with its quality, or a word of the process itself.

        `t_ms` is when it was so, UTC; now, where nothing is said.
        """
        t_ms = t_ms or self._clock.utc_ns() // NS_PER_MS
        if isinstance(value, TagValue):
            event = of_tag(t_ms, name, value)._replace(kind=int(kind))
        else:
            event = Event(0, t_ms, int(kind), name, plain(value.data if isinstance(value, DATA) else value))
        if len(self.knowledge) == self.knowledge.maxlen:
            self.dropped += 1
        self.knowledge.append(event)
        return event

    def collect(self) -> list[Event]:
        """Take everything that is there to be shared, in order."""
        taken = list(self.knowledge)
        self.knowledge.clear()
        return taken


class PTDigitalThreadProcess(DigitalThreadProcess):
    """One of the physical twin: the control logic, and the gateway with its values."""

    side = "physical"

    def put(self, name: str, value: TagValue) -> None:
        """A tag has a new value (`TagTable.on_put`)."""
        self.share(Kind.VALUE, name, value)

    def respond(self, program: str, response: RESPONSE) -> None:
        """The control logic sent this to its transmitter: a STATUS, or a measurement whose payload stays as it is."""
        self.share(Kind.STATE if isinstance(response, STATUS) else Kind.PAYLOAD, program, response)


class DTDigitalThreadProcess(DigitalThreadProcess):
    """One of the digital twin: Monitor, Analyze, Plan, Execute, a database. This one commands nobody
    (`fieldtwin.twin.thread.thread.Operator`)."""

    side = "digital"


class ReceivingEnd(EventHandler):
    """What arrives over a thread, as a queue, bounded as every other (ruling 2). All that a shadow holds of a connection
    (ruling 16): the transmitter that polls, acknowledges and asks for what is missing is assembled elsewhere."""

    def __init__(self, event: str, capacity: int = KNOWLEDGE) -> None:
        super().__init__(event)
        self.queue: deque[tuple[str, Event]] = deque(maxlen=capacity)
        self.dropped = 0

    def observe(self, origin: str, event: Event) -> None:
        """Append an event of an origin; a full queue drops its oldest and counts it."""
        if len(self.queue) == self.queue.maxlen:
            self.dropped += 1
        self.queue.append((origin, event))

    def consume(self) -> tuple[str, Event]:
        """Take the first. The queue must not be empty."""
        if not self.queue:
            raise Bug("consume from an empty queue", where=self.event)
        return self.queue.popleft()
