"""The rows of the emulated node that need no clock, over real wires: the software bus by TCP, and the kernel's vcan0."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import socket

import pytest
from canopen_rows import Row, happen, load, parse_frame
from support import eventually, run

from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.emulators.canopen.serve import Poke, serve_node
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.can.software_end import open_can_end
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.wallclock import WallClock

ROWS = [row for row in load() if row.answers_only]
ONE_OF_EACH_CASE = list({row.id.split()[0] if row.id.startswith("CO-") else row.id: row for row in ROWS}.values())
"""The rows for the kernel. It only carries frames, and all rows run on the bus in virtual time."""
VCAN0 = Endpoint.parse("can:socketcan/vcan0")


async def play_on(row: Row, where: Endpoint) -> None:
    """Each frame waits for the answers to the one before."""
    own, other = await open_can_end(where, 0), await open_can_end(where, 0)
    node, pokes = row.make(), asyncio.Queue[Poke]()
    heard: list[str] = []
    tasks = [
        asyncio.create_task(serve_node(own, node, WallClock(), pokes)),
        asyncio.create_task(listen(other, heard)),
    ]
    wanted: list[str] = [] if row.node_id == 255 else [f"{0x700 + row.node_id:03X}#00"]
    try:
        await eventually(lambda: bool(node.changes), within_s=20, what="power on")
        for at_ms, steps in itertools.groupby(row.hear, key=lambda step: step[0]):
            await says(heard, wanted, row)
            for _, what in steps:
                if what.startswith("!"):
                    await poke(node, what, pokes)
                else:
                    await other.send(parse_frame(what))
            wanted += [str(parse_frame(text)) for said_ms, text in row.say if said_ms == at_ms]
        await says(heard, wanted, row)
        await eventually(lambda: is_over(row, node), within_s=20, what=f"the end of {row.id}")
        assert heard == wanted
    finally:
        for task in tasks:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        await own.aclose()
        await other.aclose()


async def says(heard: list[str], wanted: list[str], row: Row) -> None:
    await eventually(lambda: len(heard) >= len(wanted), within_s=20, what=f"{row.id}: {wanted}")
    assert heard == wanted, row.id


async def poke(node: CanopenNode, what: str, pokes: asyncio.Queue[Poke]) -> None:
    """Trigger an event in the device, and wait until it has happened."""
    done = asyncio.Event()

    def happened(now_ns: int) -> list[CanFrame]:
        done.set()
        return happen(node, what, now_ns)

    pokes.put_nowait(happened)
    await done.wait()


def is_over(row: Row, node: CanopenNode) -> bool:
    try:
        row.check_end(node)
    except AssertionError:
        return False
    return True


async def listen(end: CanConnection, heard: list[str]) -> None:
    while True:
        heard.append(str(await end.recv()))


def test_rows_on_the_software_bus_over_tcp() -> None:
    async def main() -> None:
        server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 1_000_000)
        try:
            for row in ROWS[::4]:  # all of them run on the bus in virtual time
                await play_on(row, server.bound)
        finally:
            await server.aclose()

    run(main(), timeout_s=50)


def test_the_rows_for_the_kernel_have_every_kind_of_frame() -> None:
    def kinds(rows: list[Row]) -> set[tuple[bool, bool, int]]:
        frames = [parse_frame(text) for row in rows for _, text in row.hear + row.say if not text.startswith("!")]
        return {(frame.extended, frame.remote, frame.dlc) for frame in frames}

    assert kinds(ONE_OF_EACH_CASE) == kinds(ROWS)
    assert len(kinds(ROWS)) > 8, "lengths 0 to 8, and remote frames"


@pytest.mark.socketcan
@pytest.mark.parametrize("row", ONE_OF_EACH_CASE, ids=lambda row: row.id)
def test_rows_on_a_kernel_can_interface(row: Row) -> None:
    try:
        socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        pytest.skip("this kernel has no SocketCAN: scripts/test-vcan")
    run(play_on(row, VCAN0), timeout_s=50)
