"""LSS with several nodes on one bus, in virtual time: overlapping replies are one frame, and a scan finds all nodes."""

from __future__ import annotations

import asyncio
import contextlib

from canopen_slave_rig import RICH, unnamed
from hypothesis import given, settings
from hypothesis import strategies as st
from modbus_virtual import VirtualLoop, run_virtually

from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.lss.slave import FROM_MASTER, FROM_SLAVE, UNCONFIGURED
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.can.bus_runner import AttachedConnection, BusRunner
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FieldtwinError

IDENTIFIED = "7E4#4F00000000000000"
DICTIONARY = parse_eds(RICH)


class Scanner:
    """A master that asks for 128 bits one by one, each `gap_s` after the previous request."""

    def __init__(self, end: AttachedConnection, gap_s: float) -> None:
        self._end = end
        self._gap_s = gap_s
        self.most_replies = 0

    async def ask(self, *data: int) -> bool:
        await self._end.send(CanFrame(FROM_MASTER, bytes(data).ljust(8, b"\0")))
        replies = 0
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._gap_s):
                while True:
                    frame = await self._end.recv()
                    replies += frame.can_id == FROM_SLAVE
        self.most_replies = max(self.most_replies, replies)
        return replies > 0

    async def scan(self) -> tuple[int, ...] | None:
        """Return the lowest identity of the nodes without a node ID; that node remains in configuration."""
        if not await self.ask(0x51, 0, 0, 0, 0, 0x80, 0, 0):
            return None
        found = []
        for part in range(4):
            number = 0
            for bit in reversed(range(32)):
                if not await self.ask(0x51, *number.to_bytes(4, "little"), bit, part, part):
                    number |= 1 << bit
            assert await self.ask(0x51, *number.to_bytes(4, "little"), 0, part, (part + 1) % 4)
            found.append(number)
        return tuple(found)


async def name_all(identities: list[tuple[int, ...]], gap_s: float) -> tuple[list[tuple[int, ...]], list[int], int]:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    bus = BusRunner(1_000_000)
    where = Endpoint.parse("can:fieldtwin/127.0.0.1:1")
    nodes = [unnamed(identity) for identity in identities]
    serving = [asyncio.create_task(serve_node(bus.attach(where), node, loop)) for node in nodes]
    scanner = Scanner(bus.attach(where), gap_s)
    found = []
    try:
        while (identity := await scanner.scan()) is not None:
            found.append(identity)
            assert await scanner.ask(0x11, len(found))
            await scanner.ask(0x04, 0)
    finally:
        for task in serving:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        bus.close(FieldtwinError("scanned"))
    return found, [node.node_id for node in nodes], scanner.most_replies


identity = st.tuples(*[st.integers(0, 3) | st.integers(0, 0xFFFFFFFF)] * 4)


@given(identities=st.lists(identity, min_size=1, max_size=4, unique=True))
@settings(max_examples=8, deadline=None)
def test_co_056_all_are_found_and_named_lowest_first(identities: list[tuple[int, ...]]) -> None:
    found, node_ids, most_replies = run_virtually(name_all(identities, 0.001))
    assert found == sorted(identities)
    assert node_ids == [sorted(identities).index(identity) + 1 for identity in identities]
    assert most_replies == 1, "identical replies are one frame on the wire"


def test_co_059_a_scan_that_is_too_fast_corrupts_no_identity() -> None:
    """If the master asks again before the reply can arrive, no wrong node is identified."""

    async def main() -> tuple[int, int]:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        bus = BusRunner(20_000)
        where = Endpoint.parse("can:fieldtwin/127.0.0.1:1")
        node = unnamed((1, 2, 3, 4))
        serving = asyncio.create_task(serve_node(bus.attach(where), node, loop))
        scanner = Scanner(bus.attach(where), 0.001)
        with contextlib.suppress(AssertionError):
            await scanner.scan()
        await scanner.ask(0x11, 77)
        await scanner.ask(0x04, 0)
        hurried = node.node_id
        scanner = Scanner(bus.attach(where), 0.1)
        assert await scanner.scan() == (1, 2, 3, 4)
        serving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await serving
        bus.close(FieldtwinError("scanned"))
        return hurried, node.node_id

    assert run_virtually(main()) == (UNCONFIGURED, UNCONFIGURED)
