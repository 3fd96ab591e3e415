"""Record a live device by polling it, round by round: the tags of a profile, or the requests of another recording.

Nothing is written to the device. Rounds begin on a fixed time grid; a missed round is skipped and counted, and not repeated.
A lost connection is opened again, after growing pauses. This module must not depend on files or displays: it passes exchanges
to a function, the sink.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from fieldtwin.capture.recordings.sinks import CanLogSink
from fieldtwin.commissioning.access.address import tags_of
from fieldtwin.commissioning.access.connection import canopen_at, frames_at
from fieldtwin.commissioning.access.point import CanopenPoint
from fieldtwin.commissioning.access.reading import DeviceTarget
from fieldtwin.commissioning.record.asking import RecordingClient, asker_at, changes
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import Connector, Tap
from fieldtwin.gateway.core.errors import ConnectionLost, Unreachable, UsageError
from fieldtwin.gateway.core.files.profile import READ_FUNCTION, DeviceProfile
from fieldtwin.gateway.core.files.recording import RecordedExchange
from fieldtwin.gateway.core.values import Reason
from fieldtwin.gateway.devices.read_plan import GroupPlan, Learnt, Read
from fieldtwin.gateway.wallclock import WallClock

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 10.0
MAX_REQUESTS = 10_000
"""Maximum number of different requests that are repeated from another recording."""

Sink = Callable[[RecordedExchange], None]


@dataclass(slots=True)
class PollCounters:
    """The counts of rounds, exchanges and lost connections of a polling."""

    rounds: int = 0
    missed: int = 0
    exchanges: int = 0
    unanswered: int = 0
    refused: int = 0
    lost: int = 0


class Round(Protocol):
    """The interface of a round of requests. Calling it sends the requests through `asker` and passes the exchanges to `sink`."""

    @property
    def asks(self) -> list[tuple[int, bytes]]:
        """Return unit ID and request PDU of each request in the current round."""
        ...

    async def __call__(self, asker: RecordingClient, sink: Sink) -> None: ...


class ProfileRound:
    """A round that reads all readable tags of a profile, or of some of its poll groups, in the fewest reads. A refused read
    is recorded, and then repeated in parts.
    """

    def __init__(self, profile: DeviceProfile, unit: int, groups: Iterable[str] = ()) -> None:
        self._unit = unit
        learnt = Learnt()
        there = dict.fromkeys(t.poll for t in profile.tags.values() if t.readable)
        wanted = list(groups) or list(there)
        if unknown := [g for g in wanted if g not in there]:
            raise UsageError(f"no poll group {unknown[0]!r} in {profile.name}", expected=", ".join(there))
        self._plans = [GroupPlan(profile, group, learnt) for group in wanted]

    @property
    def asks(self) -> list[tuple[int, bytes]]:
        """Return the requests of the current round, as `Round.asks` describes."""
        return [(self._unit, _request(read)) for plan in self._plans for read in plan.reads]

    async def __call__(self, asker: RecordingClient, sink: Sink) -> None:
        for plan in self._plans:
            waiting = list(plan.reads)
            while waiting:
                waiting[:1] = await self._read(plan, waiting[0], asker, sink)
            plan.pass_ended()

    async def _read(self, plan: GroupPlan, read: Read, asker: RecordingClient, sink: Sink) -> tuple[Read, ...]:
        """Send a read and record it. Return the reads that replace it, if the device refused it and it can be divided; else
        none.
        """
        exchange = await asker.ask(self._unit, _request(read))
        if exchange is None:
            return ()
        sink(exchange)
        if not exchange.reply:
            return ()
        if exchange.reply[0] & 0x80:
            code = exchange.reply[1]
            return plan.refused(read, code) if code in (2, 3) else ()
        plan.taken(read)
        return ()


def _request(read: Read) -> bytes:
    at = read.range
    return bytes((READ_FUNCTION[at.table],)) + at.address.to_bytes(2) + at.count.to_bytes(2)


class SameRequests:
    """A round with the different requests of another recording, each once, in order.

    `left_out` counts requests that may change the device, and those beyond `MAX_REQUESTS`.
    """

    def __init__(self, exchanges: Iterable[RecordedExchange], unit: int | None = None) -> None:
        self.requests: dict[tuple[int, bytes], None] = {}
        self.left_out = 0
        for exchange in exchanges:
            key = (exchange.unit if unit is None else unit, exchange.request)
            if changes(exchange.request) or (key not in self.requests and len(self.requests) >= MAX_REQUESTS):
                self.left_out += 1
            else:
                self.requests[key] = None

    @property
    def asks(self) -> list[tuple[int, bytes]]:
        """Return the requests of the current round, as `Round.asks` describes."""
        return list(self.requests)

    async def __call__(self, asker: RecordingClient, sink: Sink) -> None:
        for unit, pdu in self.requests:
            exchange = await asker.ask(unit, pdu)
            if exchange is not None:
                sink(exchange)


async def record_polls(
    target: DeviceTarget,
    one_round: Round,
    sink: Sink,
    *,
    every_s: float,
    counters: PollCounters,
    stop: asyncio.Event,
    rounds: int = 0,
    spacing_s: float = 0.0,
    taps: Sequence[Tap] = (),
    connector: Connector | None = None,
    clock: Clock | None = None,
) -> None:
    """Poll until `stop` is set, or `rounds` are done (0: no limit).

    Raises `Unreachable` only if the first connection fails. Later failures are counted, and the connection is opened again.
    """
    clock = clock or WallClock()
    zero_ns = clock.monotonic_ns()

    def counted(exchange: RecordedExchange) -> None:
        counters.exchanges += 1
        counters.unanswered += exchange.reply is None
        counters.refused += bool(exchange.reply and exchange.reply[0] & 0x80)
        sink(exchange)

    async def on_the_grid() -> None:
        async with asker_at(
            target.url, timeout_s=target.timeout_s, echo=target.echo, spacing_s=spacing_s, zero_ns=zero_ns,
            connector=connector, clock=clock,
        ) as asker:  # fmt: skip
            await _rounds(lambda: one_round(asker, counted), clock, every_s, counters, stop, rounds)

    await _reopened(on_the_grid, counters, stop)


async def record_node(
    target: DeviceTarget,
    sink: CanLogSink,
    *,
    every_s: float,
    counters: PollCounters,
    stop: asyncio.Event,
    rounds: int = 0,
    connector: Connector | None = None,
    clock: Clock | None = None,
) -> None:
    """Record a CANopen node as `record_polls` does: read each readable tag of its profile, or each object of its EDS, by SDO.

    `sink` receives the frames. Raises `UsageError` if the target has neither profile nor EDS.
    """
    clock = clock or WallClock()
    tags = tags_of((), "canopen", None, target.profile, target.dictionary)

    async def on_the_grid() -> None:
        async with canopen_at(
            target.url, target.bitrate, sdo_timeout_s=target.timeout_s, taps=[sink], connector=connector, clock=clock
        ) as master:
            point = CanopenPoint(master, target.url, target.address)

            async def one_round() -> None:
                answers = await point.read(tags)
                counters.exchanges += len(answers)
                refused = sum(a.value.reason is Reason.REFUSED for a in answers.values())
                counters.refused += refused
                counters.unanswered += sum(bool(a.problem) for a in answers.values()) - refused
                sink.check()

            await _rounds(one_round, clock, every_s, counters, stop, rounds)

    await _reopened(on_the_grid, counters, stop)


async def _rounds(
    one_round: Callable[[], Awaitable[None]],
    clock: Clock,
    every_s: float,
    counters: PollCounters,
    stop: asyncio.Event,
    most: int,
) -> None:
    every_ns, due_ns = max(round(every_s * NS_PER_S), 1), clock.monotonic_ns()
    while not stop.is_set() and (not most or counters.rounds < most):
        await one_round()
        counters.rounds += 1
        due_ns += every_ns
        late = (clock.monotonic_ns() - due_ns) // every_ns
        if late > 0:
            counters.missed += late
            due_ns += late * every_ns
        if not most or counters.rounds < most:
            await _pause(stop, (due_ns - clock.monotonic_ns()) / NS_PER_S)


async def _reopened(work: Callable[[], Awaitable[None]], counters: PollCounters, stop: asyncio.Event) -> None:
    """Run `work`, and run it again after a pause when its connection is lost."""
    pause_s = FIRST_PAUSE_S
    while True:
        done = counters.rounds
        try:
            await work()
            return
        except ConnectionLost:
            counters.lost += 1
        except Unreachable:
            if not counters.rounds:
                raise
        if stop.is_set():
            return
        pause_s = FIRST_PAUSE_S if counters.rounds > done else min(2 * pause_s, LONGEST_PAUSE_S)
        await _pause(stop, pause_s)


async def _pause(stop: asyncio.Event, seconds: float) -> None:
    if seconds > 0:
        waiting = asyncio.ensure_future(stop.wait())
        try:
            await asyncio.wait([waiting], timeout=seconds)
        finally:
            waiting.cancel()
            await asyncio.gather(waiting, return_exceptions=True)


async def follow_bus(
    target: DeviceTarget,
    sink: CanLogSink,
    *,
    stop: asyncio.Event,
    connector: Connector | None = None,
    clock: Clock | None = None,
) -> int:
    """Write every frame of a CAN bus to `sink` until `stop`; return the number of frames that were lost because this computer was
    too slow.

    Nothing is sent. Raises `Unreachable` if the bus cannot be opened, `ConnectionLost` when it is lost.
    """
    clock = clock or WallClock()
    async with frames_at(target.url, target.bitrate, taps=[sink], connector=connector, clock=clock) as connection:
        stopping: asyncio.Future[Any] = asyncio.ensure_future(stop.wait())
        receiving: asyncio.Future[Any] | None = None
        try:
            while not stop.is_set():
                receiving = asyncio.ensure_future(connection.recv())
                await asyncio.wait([stopping, receiving], return_when=asyncio.FIRST_COMPLETED)
                if receiving.done():
                    receiving.result()
                    while connection.inbound.data_stream:
                        await connection.recv()
                sink.check()
        finally:
            waiting = [stopping, *([receiving] if receiving is not None else [])]
            for task in waiting:
                task.cancel()
            await asyncio.gather(*waiting, return_exceptions=True)
        return connection.overruns
