"""Two nodes with one node ID, and two SYNC producers on one bus, are detected wherever they are visible.

Defect: the first reply of two nodes was accepted, and the second one was dropped without a message, because the next request
had been sent meanwhile. A second SYNC producer was not detected at all.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from canopen_slave_rig import record, var
from commissioning_rig import can_bus, loop, run_virtually
from hypothesis import given
from hypothesis import strategies as st
from test_scan_canopen import URL, scan

from fieldtwin.commissioning.identify.canopen import identify_canopen
from fieldtwin.commissioning.scan.can_listener import BusListener
from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.devices.canopen_config import CanopenBusConfig, CanopenNodeConfig, cycle_period_ns
from fieldtwin.gateway.protocols.canopen.boot import Configuration
from fieldtwin.gateway.protocols.canopen.eds.concise_dcf import Setting
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.pdo.sync_watch import SyncWatch


def node(number: int, device_type: int, serial: int) -> CanopenNode:
    identity = [
        var("1018sub0", 5, "const", 4),
        *(var(f"1018sub{n}", 7, "ro", n) for n in (1, 2, 3)),
        var("1018sub4", 7, "ro", serial),
    ]
    text = "[DeviceInfo]\nVendorName=x\n" + var("1000", 7, "ro", device_type) + record("1018", identity)
    return CanopenNode(parse_eds(text + var("1017", 6, "rw", 0)), number)


def test_scan_reports_two_nodes_with_one_id() -> None:
    async def main() -> None:
        async with can_bus(node(5, 0x191, 7), node(5, 0x192, 8), node(6, 0x191, 9)) as connector:
            found = await scan(connector, nodes=(4, 5, 6), lss=False)
        assert list(found.conflicts) == [5]
        assert "two nodes seem to have the id 5" in found.conflicts[5]

    run_virtually(main())


def test_scan_names_the_two_replies() -> None:
    """The second reply comes late, after the next request, because a node with different firmware is slower."""

    async def main() -> None:
        async with can_bus(node(5, 0x191, 7)) as connector:
            other = await connector.open_can(_endpoint(), 0)
            late = asyncio.ensure_future(_answer_late(other, 0x192))
            found = await scan(connector, nodes=(5,), lss=False)
            late.cancel()
        assert found.conflicts == {
            5: "two replies to one request for 1000h:00, 43 00 10 00 91 01 00 00 and 43 00 10 00 92 01 00 00: "
            "two nodes seem to have the id 5"
        }
        assert [n.node for n in found.nodes] == [5]

    run_virtually(main())


def test_identify_is_certain_of_nothing_if_two_nodes_answer() -> None:
    async def main() -> None:
        async with can_bus(node(5, 0x191, 7)) as connector:
            other = await connector.open_can(_endpoint(), 0)
            late = asyncio.ensure_future(_answer_late(other, 0x192))
            found = await identify_canopen(URL, 5, [], connector=connector, clock=loop())
            late.cancel()
        assert "two replies to one request for 1000h:00" in found.summary
        assert found.certain is None

    run_virtually(main())


def _endpoint():  # type: ignore[no-untyped-def]
    from fieldtwin.gateway.core.endpoint import Endpoint

    return Endpoint.parse(URL)


async def _answer_late(end, device_type: int) -> None:  # type: ignore[no-untyped-def]
    """A second node 5: it answers requests for 1000h after 2 ms."""
    while True:
        frame = await end.recv()
        if frame.can_id == 0x605 and frame.data[:4] == bytes.fromhex("40001000"):
            await asyncio.sleep(0.002)
            await end.send(CanFrame(0x585, bytes.fromhex("43001000") + device_type.to_bytes(4, "little")))


@asynccontextmanager
async def mastered(connector) -> AsyncIterator[CanopenMaster]:  # type: ignore[no-untyped-def]
    master = CanopenMaster(await connector.open_can(_endpoint(), 0), loop())
    async with Nursery() as nursery:
        nursery.start(master.run(), "master")
        yield master


def test_another_client_that_reads_the_same_objects_is_not_a_second_node() -> None:
    async def main() -> None:
        async with can_bus(node(5, 0x191, 7)) as connector, mastered(connector) as ours, mastered(connector) as theirs:
            for master in (ours, theirs):
                master.add_node(5)
            for _ in range(20):
                await ours.sdo_upload(5, 0x1000, 0)
                await theirs.sdo_upload(5, 0x1000, 0)
                await theirs.sdo_upload(5, 0x1018, 4)
            assert ours.conflicts == theirs.conflicts == {}
            assert ours.counters.foreign_sdo_requests == 40
            assert theirs.counters.foreign_sdo_requests == 20

    run_virtually(main())


def test_a_sync_from_another_node_is_one_too_many_for_a_producer() -> None:
    watch = SyncWatch(own=True)
    watch.feed(b"", 0)
    assert "two producers" in watch.verdict


@given(st.integers(2, 1000), st.lists(st.floats(-0.2, 0.2), min_size=40, max_size=40))
def test_one_producer_is_not_taken_for_two(period_ms: int, jitter: list[float]) -> None:
    watch = SyncWatch()
    for number, late in enumerate(jitter):
        watch.feed(b"", round((number + late) * period_ms * NS_PER_MS))
    assert watch.verdict == ""


@given(st.integers(2, 1000), st.floats(0.05, 0.3), st.booleans())
def test_two_producers_of_one_period_are_noticed(period_ms: int, apart: float, counted: bool) -> None:
    listener = BusListener()
    for number in range(40):
        for shift in (0.0, apart):
            counter = bytes([number % 240 + 1]) if counted else b""
            listener.feed(CanFrame(0x80, counter), round((number + shift) * period_ms * NS_PER_MS))
    assert "two producers" in listener.heard.sync_producers


@pytest.mark.parametrize("restarts", [1, 2])
def test_a_producer_that_restarts_its_counter_is_still_one(restarts: int) -> None:
    watch = SyncWatch()
    for number in range(60):
        watch.feed(bytes([number % (60 // (restarts + 1)) + 1]), number * 10 * NS_PER_MS)
    assert watch.verdict == ""


EVENLY = st.tuples(st.integers(2, 1000), st.integers(2, 4), st.lists(st.floats(-0.05, 0.05), min_size=40, max_size=40))


@given(EVENLY)
def test_evenly_spaced_producers_are_detected_if_the_cycle_period_is_known(
    given_: tuple[int, int, list[float]],
) -> None:
    period_ms, producers, jitter = given_
    told, untold = SyncWatch(period_ns=period_ms * NS_PER_MS), SyncWatch()
    for number, late in enumerate(jitter):
        for watch in (told, untold):
            watch.feed(b"", round((number + late) * period_ms * NS_PER_MS / producers))
    assert f"{producers} producers" in told.verdict
    assert f"the communication cycle period is {period_ms} ms" in told.verdict
    assert untold.verdict == "", "listening alone cannot tell it from one producer"


@given(st.integers(2, 1000), st.floats(0.8, 3.0), st.lists(st.floats(-0.2, 0.2), min_size=40, max_size=40))
def test_one_producer_that_keeps_the_cycle_period_or_is_slower_is_one(
    period_ms: int, slower: float, jitter: list[float]
) -> None:
    watch = SyncWatch(period_ns=period_ms * NS_PER_MS)
    for number, late in enumerate(jitter):
        watch.feed(b"", round((number + late) * slower * period_ms * NS_PER_MS))
    assert watch.verdict == ""


def test_the_cycle_period_is_the_masters_or_the_shortest_that_a_dcf_sets() -> None:
    def of(*periods_us: int) -> CanopenNodeConfig:
        settings = [Setting(0x1006, 0, us.to_bytes(4, "little")) for us in periods_us]
        return CanopenNodeConfig(configuration=Configuration((Setting(0x1005, 0, bytes(4)), *settings)))

    silent = CanopenBusConfig()
    assert cycle_period_ns(CanopenBusConfig(sync_ms=20), [of(5000)]) == 20 * NS_PER_MS
    assert cycle_period_ns(silent, [of(10_000), of(5000), of(0), CanopenNodeConfig()]) == 5 * NS_PER_MS
    assert cycle_period_ns(silent, [of(0), of()]) == cycle_period_ns(silent, []) == 0
