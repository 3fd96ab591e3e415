"""Any CAN interface of python-can as a connection: its virtual bus, slcan to the software bus, and refused configurations."""

from __future__ import annotations

from pathlib import Path

import pytest
from support import eventually, run

from fieldtwin.commissioning.scan.canopen import CanScanner, CanScanOptions
from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.can.slcan_port import SlcanPort
from fieldtwin.gateway.connections.can.adapter import AdapterConnection
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, UsageError
from fieldtwin.gateway.wallclock import WallClock

FRAMES = (
    CanFrame(0x705, b"\x05"),
    CanFrame(0x18FF1234, b"12345678", extended=True),
    CanFrame(0x605, remote=True, dlc=8),
)


async def _exchange(one: CanConnection, other: CanConnection) -> None:
    for frame in FRAMES:
        await one.send(frame)
    got = [await other.recv() for _ in FRAMES]
    assert [g.key() for g in got] == [f.key() for f in FRAMES]
    assert all(g.t_ns for g in got)


def test_two_handles_on_a_virtual_bus_hear_each_other() -> None:
    async def main() -> None:
        url = Endpoint.parse("can:virtual/commissioning-1")
        one, other = await OsConnector().open_can(url, 0), await OsConnector().open_can(url, 0)
        assert isinstance(one, AdapterConnection)
        await _exchange(one, other)
        await _exchange(other, one)
        await one.aclose()
        await one.aclose()
        with pytest.raises(ConnectionLost):
            await one.send(FRAMES[0])
        await other.aclose()
        with pytest.raises(ConnectionLost):
            await other.recv()

    run(main())


def test_slcan_reaches_the_software_bus() -> None:
    async def main() -> None:
        server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 250_000, paced=False)
        slcan = await SlcanPort.open(server.runner, Endpoint.parse("tcp://127.0.0.1:0"))
        host, port = slcan.bound
        adapter = await OsConnector().open_can(
            Endpoint.parse(f"can:slcan/socket://{host}:{port}?bitrate=250000&sleep_after_open=0"), 0
        )
        assert isinstance(adapter, AdapterConnection)
        assert adapter.bitrate == 250_000
        node = await OsConnector().open_can(server.bound, 0)
        await eventually(lambda: len(slcan.clients) == 1)
        await _exchange(adapter, node)
        await _exchange(node, adapter)
        await adapter.aclose()
        await slcan.aclose()
        await node.aclose()
        await server.aclose()

    run(main())


@pytest.mark.parametrize(
    ("url", "bitrate", "says"),
    [
        ("can:toaster/0", 250_000, "unknown kind of CAN interface 'toaster'"),
        ("can:pcan/PCAN_USBBUS1", 0, "needs the bit rate"),
        ("can:pcan/PCAN_USBBUS1?bitrate=250000", 125_000, "two different bit rates"),
        ("can:pcan/PCAN_USBBUS1?bitrate=fast", 0, "bit/s, such as 250000"),
        ("can:vector/0?listen=1", 250_000, "no listen-only mode for vector"),
        ("can:kvaser/0?listen=yes", 250_000, "0 or 1"),
        ("can:pcan/PCAN_USBBUS1", 250_000, "driver of pcan is not installed"),
    ],
)
def test_an_impossible_command_line_is_refused_in_one_line(url: str, bitrate: int, says: str) -> None:
    async def main() -> None:
        with pytest.raises(UsageError, match=says):
            await OsConnector().open_can(Endpoint.parse(url), bitrate)

    run(main())


def test_a_scan_by_an_adapter_finds_the_node_on_the_other_bus() -> None:
    async def main() -> None:
        url = "can:virtual/commissioning-2"
        theirs = await OsConnector().open_can(Endpoint.parse(url), 0)
        node = CanopenNode(parse_eds(Path("profiles/devices/encoder-cia406.eds").read_text()), 9, NodeContext())
        async with Nursery() as nursery:
            nursery.start(serve_node(theirs, node, WallClock()), "node")
            options = CanScanOptions(nodes=(9,), listen_s=0.1, timeout_s=1, lss=False, share_bus=True)  # it boots
            found = await CanScanner(url, options).run()
            assert [(n.node, n.answers) for n in found.nodes] == [(9, True)]
            assert found.facts is not None
            assert found.facts.can_listen_only
        await theirs.aclose()

    run(main())
