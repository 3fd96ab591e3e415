"""The digital thread: one connection in each direction between two twins, and the processes whose knowledge it carries.

A process shares events; a connection collects these events into the log that its end sends to the other twin. The classes here
have the names of the paper's schemas. The protocol is in `fieldtwin.twin.thread.end`; the paper's database is the store in
which that module keeps both logs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import ClassVar, Generic, TypeVar

from fieldtwin.gateway.core.clock import NS_PER_MS, Clock
from fieldtwin.gateway.core.errors import Bug
from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.twin.model.knowledge import KnowledgeWriter
from fieldtwin.twin.model.thread_process import (
    DigitalThreadProcess,
    DTDigitalThreadProcess,
    PTDigitalThreadProcess,
    ReceivingEnd,
)
from fieldtwin.twin.site.system import System
from fieldtwin.twin.thread.end import OnEvents, ThreadEnd
from fieldtwin.twin.thread.frames import Schema

COLLECT_MS = 50


def schema_of(system: System) -> Schema:
    """Return the names that a system's two twins have in common, in the system file's order: tags, then programs and
    devices. The schema belongs to that system alone: the twin of another system of the same design can neither receive
    from this plant nor command it."""
    names = [f"{d.name}.{t.name}" for d in system.devices.values() for t in d.profile.tags.values()]
    return Schema((*names, *system.plc.programs, *system.devices), system.name)


class Operator(DTDigitalThreadProcess):
    """The process of a digital twin that decides which command is sent; a shadow has none."""

    def command(self, command: COMMAND) -> None:
        """Send a command to the physical twin."""
        self.share(Kind.COMMAND, command.name or self.name, command)

    def command_period(self, period_s: int) -> None:
        """Send a command with a sample period in seconds. Raises `Desync` if it does not fit into 16 bits."""
        self.command(encode_period(period_s))


P = TypeVar("P", bound=DigitalThreadProcess)


class ThreadConnection(Generic[P]):
    """The common part of both directions: an end (its sending side) and the processes from which it collects events.

    `pump` moves the events that the processes share into the writer of the log that the end sends.
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
        """Collect the events that the processes share, and return their number."""
        count = 0
        for process in self.collect_from:
            for event in process.collect():
                self._writer.observe(event)
                count += 1
        return count

    async def run(self) -> None:
        """Call `pump` periodically until cancelled."""
        while True:
            self.pump()
            await self._clock.sleep_until_ns(self._clock.monotonic_ns() + COLLECT_MS * NS_PER_MS)


class PTtoDTConnection(ThreadConnection[PTDigitalThreadProcess]):
    """The paper's PTtoDTConnection, which carries measurements and statuses to the digital twin."""

    collects = PTDigitalThreadProcess


class DTtoPTConnection(ThreadConnection[DTDigitalThreadProcess]):
    """The paper's DTtoPTConnection, which carries commands to the physical twin."""

    collects = DTDigitalThreadProcess


class DigitalThread:
    """The paper's DigitalThread: one connection in each direction."""

    def __init__(self, pt_data: PTtoDTConnection, dt_data: DTtoPTConnection) -> None:
        if type(pt_data) is not PTtoDTConnection or type(dt_data) is not DTtoPTConnection:
            raise Bug("a thread is one connection each way", expected="PTtoDTConnection and DTtoPTConnection")
        self.pt_data = pt_data
        self.dt_data = dt_data


def to_receivers(*receivers: ReceivingEnd) -> OnEvents:
    """Return a function that passes arriving events on to every receiving end, in order."""

    async def pass_on(origin: str, events: Sequence[Event]) -> None:
        for event in events:
            for receiver in receivers:
                receiver.observe(origin, event)

    return pass_on
