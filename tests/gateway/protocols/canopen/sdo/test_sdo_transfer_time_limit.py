"""A whole SDO transfer has a time limit, also if its node sends enough bytes to pass for a slow one.

A node that drips an object of unknown length is cut off when it sends fewer than 20 bytes a second. Before there was a
limit of the whole transfer, a node that sends a little more than that held the channel for 14.5 hours, until 1 MiB was
full. The nodes here are on the software CAN bus, at 125 kbit/s and in virtual time.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from nodes_on_a_bus import on_bus

from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ReplyTimeout
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.sdo.transfers import WHOLE_S

EVERY_S = 0.34
"""7 bytes in less than 350 ms: a little faster than the slowest node that is not cut off earlier."""


class Dripper:
    """Node 5 sends an object that never ends, 7 bytes at a time; node 6 answers at once with a number."""

    def __init__(self, segments: int = 1 << 30) -> None:
        self.aborts: list[bytes] = []
        self.uploads = 0
        self.ignores = 0
        """How many of the next uploads get no reply."""
        self._segments = self._left = segments

    async def serve(self, connection: CanConnection, clock: VirtualClock) -> None:
        while True:
            frame = await connection.recv()
            request, multiplexor = frame.data, frame.data[1:4]
            if frame.can_id == 0x606:
                await connection.send(CanFrame(0x586, b"\x43" + multiplexor + b"\x2a\0\0\0"))
            elif frame.can_id == 0x605 and request[0] == 0x80:
                self.aborts.append(request)
            elif frame.can_id == 0x605 and request[0] == 0x40 and self.ignores:
                self.ignores -= 1
            elif frame.can_id == 0x605 and request[0] == 0x40:
                self.uploads += 1
                self._left = self._segments
                await connection.send(CanFrame(0x585, b"\x40" + multiplexor + bytes(4)))
            elif frame.can_id == 0x605:
                self._left -= 1
                last = self._left <= 0
                reply = CanFrame(0x585, bytes([request[0] & 0x10 | last]) + b"content")
                asyncio.get_running_loop().call_later(EVERY_S, self._reply, connection, reply)

    def _reply(self, connection: CanConnection, reply: CanFrame) -> None:
        self._sending = asyncio.ensure_future(connection.send(reply))


@asynccontextmanager
async def master_on(net: MemoryNet, url: str, clock: VirtualClock, **settings: float) -> AsyncIterator[CanopenMaster]:
    connection = await net.open_can(Endpoint.parse(url), 125_000)
    master = CanopenMaster(connection, clock, sdo_timeout_s=1.0, sdo_retries=1, **settings)  # type: ignore[arg-type]
    task = asyncio.ensure_future(master.run())
    try:
        yield master
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await connection.aclose()


def test_a_drip_of_unknown_length_ends_at_the_limit_of_the_whole_transfer() -> None:
    """The master aborts the transfer once and does not repeat it; meanwhile it reads another node."""
    node = Dripper()

    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> None:
        async with master_on(net, url, clock) as master:
            began_ns = clock.monotonic_ns()
            dripping = asyncio.ensure_future(master.sdo_upload(5, 0x2000, 0))
            read = 0
            while not dripping.done():
                assert await master.sdo_upload(6, 0x2000, 0) == b"\x2a\0\0\0"
                read += 1
                await asyncio.sleep(1.0)
                assert clock.monotonic_ns() - began_ns < (WHOLE_S + 5) * NS_PER_S, "it still drips"
            with pytest.raises(ReplyTimeout, match=r"not complete after 600 s and 12\d{3} bytes"):
                await dripping
            assert read >= WHOLE_S - 5
            assert master.counters.sdo_retries == 0
        assert [abort[4:8].hex(" ") for abort in node.aborts] == ["00 00 04 05"]
        assert node.uploads == 1

    on_bus(node.serve, use)


def test_a_stated_limit_applies_to_its_node_only() -> None:
    """An object of 35 s is read whole with the usual limit, and not from a node with a limit of 20 s."""

    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> None:
        async with master_on(net, url, clock) as master:
            master.add_node(6, sdo_transfer_s=20.0)
            assert len(await master.sdo_upload(5, 0x2000, 0)) == 700
            master.add_node(5, sdo_transfer_s=20.0)
            began_ns = clock.monotonic_ns()
            with pytest.raises(ReplyTimeout, match="not complete after 20 s"):
                await master.sdo_upload(5, 0x2000, 0)
            assert clock.monotonic_ns() - began_ns == pytest.approx(20 * NS_PER_S, abs=NS_PER_S)

    on_bus(Dripper(100).serve, use)


def test_a_limit_of_all_nodes_of_a_bus() -> None:
    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> None:
        async with master_on(net, url, clock, sdo_transfer_s=10.0) as master:
            with pytest.raises(ReplyTimeout, match="not complete after 10 s"):
                await master.sdo_upload(5, 0x2000, 0, retries=3)

    on_bus(Dripper(100).serve, use)


def test_a_limit_below_the_timeout_does_not_shorten_the_wait_for_a_reply() -> None:
    """A node without a reply is asked again, as it is without that limit."""

    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> None:
        async with master_on(net, url, clock, sdo_transfer_s=0.1) as master:
            with pytest.raises(ReplyTimeout, match="the node does not answer"):
                await master.sdo_upload(7, 0x2000, 0)
            assert master.counters.sdo_retries == 1
            with pytest.raises(ReplyTimeout, match="not complete after 1 s"):
                await master.sdo_upload(5, 0x2000, 0)

    on_bus(Dripper().serve, use)


def test_the_upload_that_gets_past_a_late_reply_has_the_same_limit() -> None:
    """After a request without a reply, the master reads another object first; the node drips that one."""
    node = Dripper()
    node.ignores = 1

    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> None:
        async with master_on(net, url, clock, sdo_transfer_s=20.0) as master:
            with pytest.raises(ReplyTimeout, match="no reply to the request"):
                await master.sdo_upload(5, 0x2000, 0, retries=0)
            began_ns = clock.monotonic_ns()
            with pytest.raises(ReplyTimeout, match="the node does not answer"):
                await master.sdo_upload(5, 0x2000, 0, retries=0)
            assert clock.monotonic_ns() - began_ns == pytest.approx(20 * NS_PER_S, abs=NS_PER_S)

    on_bus(node.serve, use)
