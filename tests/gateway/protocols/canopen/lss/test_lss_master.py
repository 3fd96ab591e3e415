"""The LSS master against slaves on a bus in memory with arbitrary delays: it finds all, one by one, without confusing them."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from canopen_master_bus import MemoryEnd, bus, running
from hypothesis import given, settings
from hypothesis import strategies as st
from lss_slave import Slave
from modbus_virtual import VirtualLoop, run_virtually
from support import eventually

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import ReplyTimeout, UsageError
from fieldtwin.gateway.protocols.canopen.lss.frames import LssAddress, LssRefused
from fieldtwin.gateway.protocols.canopen.lss.master import LssMaster
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster

REPLY_S = 0.01


async def serve(end: MemoryEnd, slaves: list[Slave]) -> None:
    loop = asyncio.get_running_loop()
    while True:
        request = await end.recv()
        if request.can_id == 0x7E5:
            for slave in slaves:
                reply = slave.take(request.data)
                if reply is not None:
                    loop.call_later(slave.delay_s, end.peer.feed, CanFrame(0x7E4, reply.ljust(8, b"\0")))


@asynccontextmanager
async def master_of(slaves: list[Slave]) -> AsyncIterator[LssMaster]:
    ours, theirs = bus()
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    master = CanopenMaster(ours, loop)
    lss = LssMaster(master.send, loop, reply_s=REPLY_S)
    master.listen(0x7E4, lss.on_reply)
    serving = asyncio.ensure_future(serve(theirs, slaves))
    async with running(master):
        yield lss
    serving.cancel()
    await asyncio.gather(serving, return_exceptions=True)


def test_co056_of_several_slaves_one_is_found_and_the_others_wait() -> None:
    """Their replies come one after the other, each within the maximum delay: they count as one."""

    async def main() -> None:
        slaves = [
            Slave((7, 2, 3, 0x8000_0001), delay_s=0.0099),
            Slave((7, 2, 3, 0x4000_0000), delay_s=0.001),
            Slave((7, 0xFFFF_FFFF, 0, 0), delay_s=0.005),
        ]
        async with master_of(slaves) as lss:
            for node in (10, 11, 12):
                found = await lss.fastscan()
                assert found is not None
                assert [s.configuring for s in slaves].count(True) == 1
                chosen = next(s for s in slaves if s.configuring)
                assert found.parts == chosen.address
                await lss.configure_node_id(node)
                await lss.store()
                await lss.switch_all(configuration=False)
            assert await lss.fastscan() is None
        assert [(s.node, s.stored) for s in slaves] == [(11, 11), (10, 10), (12, 12)]

    run_virtually(main())


WORDS = st.one_of(st.integers(0, 3), st.integers(0, 0xFFFF_FFFF))


@settings(max_examples=8, deadline=None)
@given(
    addresses=st.lists(st.tuples(WORDS, WORDS, WORDS, WORDS), min_size=1, max_size=4, unique=True),
    delays=st.lists(st.floats(0.0, 0.0099), min_size=4, max_size=4),
)
def test_co059_whatever_the_delays_the_address_found_is_a_slave_s(
    addresses: list[tuple[int, int, int, int]], delays: list[float]
) -> None:
    async def main() -> None:
        slaves = [Slave(a, delay_s=d) for a, d in zip(addresses, delays, strict=False)]
        async with master_of(slaves) as lss:
            found = await lss.fastscan()
            assert found is not None
            assert found.parts == min(addresses)
            assert lss.ignored == 0

    run_virtually(main())


def test_co057_slaves_that_have_a_node_id_keep_quiet() -> None:
    async def main() -> None:
        async with master_of([Slave((1, 2, 3, 4), node=5)]) as lss:
            assert await lss.fastscan() is None
            assert not await lss.any_unconfigured()

    run_virtually(main())


def test_the_one_with_that_address_is_configured_and_asked() -> None:
    async def main() -> None:
        slaves = [Slave((1, 2, 3, 4)), Slave((1, 2, 3, 5))]
        async with master_of(slaves) as lss:
            assert await lss.any_unconfigured()
            await lss.select(LssAddress(1, 2, 3, 5))
            assert await lss.inquire_address() == LssAddress(1, 2, 3, 5)
            assert await lss.inquire_node_id() == 0xFF
            await lss.configure_bit_rate(250_000)
            with pytest.raises(LssRefused, match="bit timing not supported"):
                await lss.configure_bit_rate(20_000)
            await lss.activate_bit_rate(100)
            await lss.assign(LssAddress(1, 2, 3, 5), 9)
            await eventually(lambda: [(s.node, s.stored) for s in slaves] == [(0xFF, None), (9, 9)])

    run_virtually(main())


def test_two_that_are_named_at_once_get_each_its_own_node_id() -> None:
    async def main() -> None:
        slaves = [Slave((1, 2, 3, 4), delay_s=0.003), Slave((1, 2, 3, 5), node=100)]
        async with master_of(slaves) as lss:
            had = await asyncio.gather(
                lss.assign(LssAddress(1, 2, 3, 4), 8), lss.assign(LssAddress(1, 2, 3, 5), 9, store=False)
            )
            assert had == [0xFF, 100]
            await eventually(lambda: [(s.node, s.stored) for s in slaves] == [(8, 8), (9, None)])

    run_virtually(main())


def test_a_missing_device_is_reported_and_wrong_use_refused() -> None:
    async def main() -> None:
        async with master_of([Slave((1, 2, 3, 4))]) as lss:
            with pytest.raises(ReplyTimeout, match="no slave is"):
                await lss.select(LssAddress(1, 2, 3, 9))
            with pytest.raises(ReplyTimeout, match="configuration state"):
                await lss.inquire_node_id()
            with pytest.raises(UsageError):
                await lss.configure_bit_rate(123_456)
            with pytest.raises(UsageError):
                await lss.activate_bit_rate(70_000)
            with pytest.raises(UsageError):
                LssAddress(1, 2, 3, 1 << 32)

    run_virtually(main())
