"""Compare a live device with a recording by repeating its requests in order. Only reads are repeated, unless writes are
requested.

This module must not depend on a display; its caller decides which writes are allowed.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

from fieldtwin.capture.decoding.canopen_bus import CanopenBusDecoder
from fieldtwin.capture.decoding.exchange import DecodedExchange as Transfer
from fieldtwin.capture.decoding.modbus_pdu import parse_request
from fieldtwin.capture.recordings.aligning import Dialogue
from fieldtwin.capture.recordings.comparing import Comparer, Comparison, Rules
from fieldtwin.capture.recordings.comparing_can import TRANSFERS, Frames, compare_logs
from fieldtwin.commissioning.access.connection import canopen_at
from fieldtwin.commissioning.access.reading import DeviceTarget
from fieldtwin.commissioning.record.asking import RecordingClient, changes
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import Connector, Direction, Tap
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import SdoAborted, WireError
from fieldtwin.gateway.core.files.recording import RecordedExchange
from fieldtwin.gateway.wallclock import WallClock

MAX_FRAMES = 1_000_000
"""Maximum number of frames of a live bus that are kept for the comparison."""

Progress = Callable[[int], None]
Cell = tuple[str, int]
"""A register or bit: its table and address."""


def cells_written(request: bytes) -> set[Cell]:
    """Return the registers and bits that a request writes."""
    span = parse_request(request).write_span
    return {(span.table, span.address + i) for i in range(span.count)} if span is not None else set()


async def compare_device(
    recorded: Iterable[RecordedExchange],
    asker: RecordingClient,
    comparer: Comparer,
    *,
    unit: int | None = None,
    writes: bool = False,
    wearing: Collection[Cell] = (),
    most: int = 0,
    stop: asyncio.Event | None = None,
    progress: Progress = lambda done: None,
) -> None:
    """Repeat `most` (0: all) of the recorded requests, to the recorded unit or to `unit`, and give the exchanges to `comparer`.

    Requests that may change the device are omitted and counted, unless `writes`; repeated writes to a register or bit in
    `wearing` (EEPROM) are always omitted. Raises `ConnectionLost`.

    The verdict does not depend on how often the device was read before: its values may continue the recorded ones at any
    position, see `aligning`.
    """
    dialogue = Dialogue()
    try:
        await _ask_all(recorded, asker, comparer, dialogue, unit, writes, wearing, most, stop, progress)
    finally:
        for pair in dialogue.aligned(comparer.is_equal):
            if pair.recorded is None:
                comparer.not_compared()
            else:
                comparer.add(pair.recorded, pair.other)
        comparer.shifted(dialogue.shifts)


async def _ask_all(
    recorded: Iterable[RecordedExchange],
    asker: RecordingClient,
    comparer: Comparer,
    dialogue: Dialogue,
    unit: int | None,
    writes: bool,
    wearing: Collection[Cell],
    most: int,
    stop: asyncio.Event | None,
    progress: Progress,
) -> None:
    done, worn = 0, set[Cell]()
    for exchange in recorded:
        if (most and done >= most) or (stop is not None and stop.is_set()):
            if dialogue.is_full:
                return
            dialogue.rest(exchange)
            continue
        written = cells_written(exchange.request).intersection(wearing) if wearing else set()
        if (changes(exchange.request) and not writes) or not worn.isdisjoint(written):
            comparer.left_out(exchange)
            continue
        worn |= written
        other = await asker.ask(exchange.unit if unit is None else unit, exchange.request)
        if other is None:
            comparer.left_out(exchange)
            continue
        dialogue.add(exchange, other)
        done += 1
        progress(done)


class _Kept(Tap):
    """An observer that stores the frames on the bus as (ns, frame), up to `MAX_FRAMES`."""

    def __init__(self) -> None:
        self.frames: list[tuple[int, CanFrame]] = []

    def on_bytes(self, endpoint: Endpoint, direction: Direction, t_ns: int, data: bytes) -> None:
        """Ignore bytes: a CAN bus transfers only frames."""

    def on_frame(self, endpoint: Endpoint, direction: Direction, t_ns: int, frame: CanFrame) -> None:
        if len(self.frames) < MAX_FRAMES:
            self.frames.append((t_ns, frame))


def transfers_of(frames: Frames, node: int | None) -> Iterator[Transfer]:
    """Yield the SDO transfers in the frames of a log, of `node` or (None) of all nodes."""
    wire = CanopenBusDecoder("can", ())
    for t_ns, frame in frames:
        for exchange in wire.feed(frame, t_ns)[1]:
            if exchange.service in TRANSFERS and node in (None, exchange.unit):
                yield exchange


def uploads_of(frames: Frames, node: int | None) -> Iterator[Transfer]:
    """Yield the SDO uploads in the frames of a log: the transfers that only read."""
    return (exchange for exchange in transfers_of(frames, node) if exchange.service == TRANSFERS[0])


async def compare_node(
    recorded: Callable[[], Frames],
    target: DeviceTarget,
    rules: Rules,
    *,
    node: int | None = None,
    most: int = 0,
    listen_s: float = 0.0,
    taps: Sequence[Tap] = (),
    stop: asyncio.Event | None = None,
    progress: Progress = lambda done: None,
    connector: Connector | None = None,
    clock: Clock | None = None,
) -> Comparison:
    """Repeat the SDO uploads of a log, for `node` or for all nodes in it, and compare the results.

    With `listen_s`, listen for that many seconds afterwards, and compare unrequested messages as well. Raises
    `Unreachable`, `ConnectionLost`.
    """
    clock, kept = clock or WallClock(), _Kept()
    nodes, left_out = set[int](), 0
    async with canopen_at(
        target.url, target.bitrate, sdo_timeout_s=target.timeout_s, taps=[kept, *taps], connector=connector, clock=clock
    ) as master:
        done = 0
        for exchange in transfers_of(recorded(), node):
            if exchange.service != "SDO upload":
                left_out += 1
                continue
            if (most and done >= most) or (stop is not None and stop.is_set()):
                break
            span = exchange.spans[0]
            nodes.add(exchange.unit)
            try:
                await master.sdo_upload(exchange.unit, span.address, span.subindex)
            except (SdoAborted, WireError):
                pass  # a refusal or a missing reply is compared too, because the recorded frames contain it
            done += 1
            progress(done)
        if listen_s:
            await clock.sleep_until_ns(clock.monotonic_ns() + round(listen_s * NS_PER_S))
    result = compare_logs(
        recorded(), kept.frames, rules, profile=target.profile, nodes=nodes, messages=listen_s > 0, uploads=done
    )
    result.left_out = left_out
    return result
