"""The digital thread: a connection each way between two twins, and the processes whose knowledge goes over it.

A process shares events; a connection collects them from its processes into the log that its end sends. Here the paper's
schemas have their names; what goes over the wire is `twin.thread_end`, and the database is the store that it keeps both logs in.
"""

from __future__ import annotations

from abc import ABC
from collections import deque
from collections.abc import Iterable, Sequence
from typing import ClassVar, Generic, TypeVar

from gateway.core.clock import NS_PER_MS, Clock
from gateway.core.errors import Bug
from gateway.core.events import EventHandler
from gateway.core.statemachine import encode_period
from gateway.core.values import COMMAND, DATA, RESPONSE, STATUS, TagValue
from gateway.store.event import Event, Kind, of_tag, plain
from twin.knowledge import KnowledgeWriter
from twin.system import System
from twin.thread_end import OnEvents, ThreadEnd
from twin.thread_frames import Schema

KNOWLEDGE = 10_000
"""Events that a process keeps to be shared."""
COLLECT_MS = 50


def schema_of(system: System) -> Schema:
    """The names that a system's two twins have in common, in the system file's order: tags, then programs and devices."""
    names = [f"{d.name}.{t.name}" for d in system.devices.values() for t in d.profile.tags.values()]
    return Schema((*names, *system.plc.programs, *system.devices))


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

    def share(self, kind: Kind, name: str, value: DATA | TagValue | str | int | float | None) -> Event:
        """Add to what is to be shared: a payload as it is, a tag with its quality, or a word of the process itself."""
        t_ms = self._clock.utc_ns() // NS_PER_MS
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
    """One of the digital twin: Monitor, Analyze, Plan, Execute, and the one that decides which command is sent."""

    side = "digital"

    def command(self, command: COMMAND) -> None:
        """Command the physical twin."""
        self.share(Kind.COMMAND, command.name or self.name, command)

    def command_period(self, period_s: int) -> None:
        """Command a period in seconds. Raises `Desync` outside of 16 bits."""
        self.command(encode_period(period_s))


P = TypeVar("P", bound=DigitalThreadProcess)


class ThreadConnection(Generic[P]):
    """What both directions have in common: an end (the transmitter's side of it) and the processes that it collects from.

    `pump` moves what the processes share into the writer of the log that the end sends.
    """

    collects: ClassVar[type[DigitalThreadProcess]]

    def __init__(self, connection: ThreadEnd, collect_from: Iterable[P], writer: KnowledgeWriter, clock: Clock) -> None:
        self.connection = connection
        self.collect_from: tuple[P, ...] = tuple(collect_from)
        for process in self.collect_from:
            if not isinstance(process, self.collects):
                raise Bug(f"a {type(self).__name__} collects from {process.name}", expected=self.collects.__name__)
        self._writer = writer
        self._clock = clock

    def pump(self) -> int:
        """Take what the processes share; how many events."""
        count = 0
        for process in self.collect_from:
            for event in process.collect():
                self._writer.observe(event)
                count += 1
        return count

    async def run(self) -> None:
        """Pump for good."""
        while True:
            self.pump()
            await self._clock.sleep_until_ns(self._clock.monotonic_ns() + COLLECT_MS * NS_PER_MS)


class PTtoDTConnection(ThreadConnection[PTDigitalThreadProcess]):
    """SPEC row PTtoDTConnection: measurements and statuses, to the digital twin."""

    collects = PTDigitalThreadProcess


class DTtoPTConnection(ThreadConnection[DTDigitalThreadProcess]):
    """SPEC row DTtoPTConnection: commands, to the physical twin."""

    collects = DTDigitalThreadProcess


class DigitalThread:
    """SPEC row DigitalThread: one connection each way."""

    def __init__(self, pt_data: PTtoDTConnection, dt_data: DTtoPTConnection) -> None:
        if type(pt_data) is not PTtoDTConnection or type(dt_data) is not DTtoPTConnection:
            raise Bug("a thread is one connection each way", expected="PTtoDTConnection and DTtoPTConnection")
        self.pt_data = pt_data
        self.dt_data = dt_data


class EventConsumer(EventHandler):
    """Observes what arrives over a thread, bounded as every queue (ruling 2). What a shadow holds of a connection (ruling 16)."""

    def __init__(self, event: str, capacity: int = KNOWLEDGE) -> None:
        super().__init__(event)
        self.queue: deque[tuple[str, Event]] = deque(maxlen=capacity)
        self.dropped = 0

    def observe(self, origin: str, event: Event) -> None:
        if len(self.queue) == self.queue.maxlen:
            self.dropped += 1
        self.queue.append((origin, event))

    def consume(self) -> tuple[str, Event]:
        """Take the first. The queue must not be empty."""
        if not self.queue:
            raise Bug("consume from an empty queue", where=self.event)
        return self.queue.popleft()


def to_consumers(*consumers: EventConsumer) -> OnEvents:
    """What passes arriving events on to every consumer, in order."""

    async def pass_on(origin: str, events: Sequence[Event]) -> None:
        for event in events:
            for consumer in consumers:
                consumer.observe(origin, event)

    return pass_on
