"""The emulated node against the rows of tests/vectors/canopen_slave.toml: as a pure object, and on the software bus."""

from __future__ import annotations

import asyncio
import contextlib

import pytest
from canopen_rows import Row, happen, load, parse_frame, play
from modbus_virtual import VirtualLoop, run_virtually

from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.emulators.canopen.serve import Poke, serve_node
from fieldtwin.emulators.endpoints.can.bus_runner import BusRunner
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FieldtwinError

ROWS = load()
BIT_RATE = 1_000_000
WIRE_MS = 2.0
"""A few frames at 1 Mbit/s, which is the delay that the bus may add to any time of a row."""


def test_ids_are_unique() -> None:
    assert len({row.id for row in ROWS}) == len(ROWS)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.id)
def test_row_on_the_node_alone(row: Row) -> None:
    node = row.make()
    said = play(row, node)
    assert [frame.key() for frame in frames(said)] == [frame.key() for frame in frames(row.say)]
    assert [at for at, _ in said] == [at for at, _ in row.say]
    row.check_end(node)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.id)
def test_on_the_software_bus(row: Row) -> None:
    said, node = run_virtually(on_bus(row))
    assert [frame.key() for frame in frames(said)] == [frame.key() for frame in frames(row.say)]
    late = [round(at - expected, 3) for (at, _), (expected, _) in zip(said, row.say, strict=True)]
    assert all(0 <= ms <= WIRE_MS for ms in late), late
    row.check_end(node)


def frames(said: list[tuple[float, str]]) -> list[CanFrame]:
    return [parse_frame(text) for _, text in said]


async def on_bus(row: Row) -> tuple[list[tuple[float, str]], CanopenNode]:
    """Run the row with a bus between; return the frames at the other end with their times, without the initial boot-up."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    bus = BusRunner(BIT_RATE)
    where = Endpoint.parse("can:fieldtwin/127.0.0.1:1")
    own, other = bus.attach(where, "node"), bus.attach(where, "tester")
    node, pokes = row.make(), asyncio.Queue[Poke]()
    serving = asyncio.create_task(serve_node(own, node, loop, pokes))
    heard: list[tuple[float, str]] = []
    listening = asyncio.create_task(listen(other, loop, heard))
    await asyncio.sleep(0.001)  # a frame sent together with the boot-up may be merged with it
    start_ns = loop.monotonic_ns()
    try:
        for at_ms, what in row.hear:
            await loop.sleep_until_ns(start_ns + round(at_ms * 1e6))
            if what.startswith("!"):
                pokes.put_nowait(lambda now_ns, what=what: happen(node, what, now_ns))  # type: ignore[misc]
            else:
                await other.send(parse_frame(what))
        await loop.sleep_until_ns(start_ns + round((row.until_ms + WIRE_MS) * 1e6))
    finally:
        for task in (serving, listening):
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        bus.close(FieldtwinError("the row is over"))
    boot = [] if row.node_id == 255 else [heard.pop(0)[1]]
    assert boot in ([], [f"{0x700 + row.node_id:03X}#00"])
    return [(at_ms - start_ns / 1e6, text) for at_ms, text in heard], node


async def listen(end: CanConnection, loop: VirtualLoop, heard: list[tuple[float, str]]) -> None:
    while True:
        frame = await end.recv()
        heard.append((loop.monotonic_ns() / 1e6, str(frame)))
