"""Faults between two third-party CAN buses: `fieldtwin link --faults FILE can:NEAR can:FAR`."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest
from support import eventually, run

from fieldtwin.emulators.can_link import CanLink, node_of
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.faults.frames import FrameDirection, Framing
from fieldtwin.emulators.faults.on_link import check_can_link, wire_faults
from fieldtwin.emulators.faults.schema import parse_fault
from fieldtwin.emulators.faults.wrong_aim import WrongAim
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost

ANY_PORT = Endpoint.parse("can:fieldtwin/127.0.0.1:0")
ASK, ANSWER = CanFrame(0x605, bytes.fromhex("4000200000000000")), CanFrame(0x585, bytes.fromhex("4300200057040000"))
BEAT, OTHER = CanFrame(0x705, b"\x7f"), CanFrame(0x706, b"\x05")


@contextlib.asynccontextmanager
async def strangers(*said: dict[str, Any]) -> AsyncIterator[tuple[CanConnection, CanConnection, CanLink]]:
    """A client's end, a node's end, and the link between their buses."""
    near, far = [await SoftBusServer.open(ANY_PORT, 1_000_000, paced=False) for _ in range(2)]
    now_ns = round(asyncio.get_running_loop().time() * NS_PER_S)
    link = CanLink(near.attach("link"), far.attach("link"), wire_faults(said, Framing.RAW, 1, now_ns, check_can_link))
    link.start()
    try:
        yield near.attach("master"), far.attach("node"), link
    finally:
        await link.aclose()
        await link.aclose()
        await near.aclose()
        await far.aclose()


async def heard(at: CanConnection, count: int) -> list[CanFrame]:
    """Read so many frames, without their times."""
    async with asyncio.timeout(5):
        return [CanFrame(frame.can_id, frame.data) for frame in [await at.recv() for _ in range(count)]]


def test_frames_without_a_fault_pass_in_both_directions_in_order() -> None:
    async def main() -> None:
        async with strangers({"name": "lost-frame", "cob_id": 0x705}) as (master, node, link):
            await master.send(ASK)
            assert await heard(node, 1) == [ASK]
            for frame in (BEAT, ANSWER, OTHER):
                await node.send(frame)
            assert await heard(master, 2) == [ANSWER, OTHER]
            assert link.passed == {FrameDirection.REQUEST: 1, FrameDirection.REPLY: 2}

    run(main())


def test_a_node_is_struck_and_its_neighbour_is_not() -> None:
    async def main() -> None:
        async with strangers({"name": "odd-heartbeat", "unit": 5, "state": 4}) as (master, node, _):
            await node.send(BEAT)
            await node.send(OTHER)
            assert [frame.data for frame in await heard(master, 2)] == [b"\x04", OTHER.data]

    run(main())


def test_a_request_is_lost_on_its_way_to_the_node() -> None:
    async def main() -> None:
        async with strangers({"name": "lost-frame", "direction": "request", "index": 0x2000, "nth": 1}) as both:
            master, node, link = both
            await master.send(ASK)
            await master.send(ASK)
            assert await heard(node, 1) == [ASK]
            await node.send(ANSWER)
            assert await heard(master, 1) == [ANSWER]
            assert link.passed[FrameDirection.REQUEST] == 1

    run(main())


def test_a_delayed_frame_comes_after_its_followers() -> None:
    async def main() -> None:
        async with strangers({"name": "late-frame", "cob_id": 0x705, "by_ms": 30}) as (master, node, _):
            await node.send(BEAT)
            await node.send(ANSWER)
            assert await heard(master, 2) == [ANSWER, BEAT]

    run(main())


def test_a_fault_that_sends_speaks_for_the_node_that_it_names() -> None:
    async def main() -> None:
        async with strangers({"name": "boot-storm", "unit": 9, "count": 3, "every_ms": 1}) as (master, _, link):
            assert await heard(master, 3) == [CanFrame(0x709, b"\0")] * 3
            assert link.passed[FrameDirection.REPLY] == 3

    run(main())


def test_a_bus_that_ends_ends_the_link() -> None:
    async def main() -> None:
        near, far = [await SoftBusServer.open(ANY_PORT, 1_000_000, paced=False) for _ in range(2)]
        link = CanLink(near.attach("link"), far.attach("link"), wire_faults([], Framing.RAW, 1, 0, check_can_link))
        link.start()
        await far.aclose()
        await eventually(link.ended.done)
        assert isinstance(link.ended.result(), ConnectionLost)
        await link.aclose()
        await near.aclose()

    run(main())


@pytest.mark.parametrize(
    ("frame", "node"),
    [
        (CanFrame(0x000, b"\x01\x05"), 5),
        (CanFrame(0x000, b"\x81\x00"), 0),
        (CanFrame(0x080), 0),
        (CanFrame(0x17F, b"\x01"), 0x7F),
        (CanFrame(0x605, bytes(8), extended=True), 0),
    ],
)
def test_a_frame_belongs_to_the_node_of_its_can_id(frame: CanFrame, node: int) -> None:
    assert node_of(frame) == node


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ({"name": "bus-off"}, "needs a modelled bus"),
        ({"name": "emcy-burst"}, "expected unit: the node ID"),
        ({"name": "silence"}, "expected one of a CAN bus"),
        (
            {"name": "lost-frame", "device": "inclinometer"},
            "a link has no device or bus names; expected unit, cob_id, index",
        ),
        ({"name": "stuck", "device": "ctd", "register": "pressure"}, "expected one of a CAN bus"),
    ],
)
def test_unsupported_faults_of_a_link_of_buses(fault: dict[str, Any], told: str) -> None:
    with pytest.raises(WrongAim, match=told):
        check_can_link(parse_fault(fault))
