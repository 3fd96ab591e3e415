"""The emulated node with the `canopen` package's client and LSS master, on the software bus, in real time."""

from __future__ import annotations

import asyncio
import contextlib
import io
from collections.abc import Callable
from typing import Any

import canopen
import pytest
from canopen_localnode import DUMMIES
from canopen_slave_rig import NODE, RICH
from support import run

from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.lss.slave import UNCONFIGURED
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.canopen.service import NmtState
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.gateway.connections.soft_bus import SoftBus
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.wallclock import WallClock

BIT_RATE = 1_000_000
BLOB = bytes(range(256)) * 20 + b"and a little more"


def with_client(nodes: list[CanopenNode], client: Callable[[canopen.Network], None]) -> None:
    """Run the nodes on one software bus while `client` works on it in a thread, as programs with that package do."""

    async def main() -> None:
        server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), BIT_RATE)
        ends = [server.attach(f"node {number}") for number in range(len(nodes))]
        serving = [
            asyncio.create_task(serve_node(end, node, WallClock())) for end, node in zip(ends, nodes, strict=True)
        ]
        try:
            host, port = server.bound.address
            await asyncio.to_thread(work, f"{host}:{port}", client)
        finally:
            for task in serving:
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await task
            await server.aclose()

    run(main(), timeout_s=60)


def work(channel: str, client: Callable[[canopen.Network], None]) -> None:
    network = canopen.Network(bus=SoftBus(channel))
    network.connect()
    try:
        client(network)
    finally:
        network.disconnect()


def remote_node(network: canopen.Network) -> Any:
    sheet = io.StringIO(RICH.replace("VendorNumber=\n", "VendorNumber=0\n").replace("Dummy0005=1\n", DUMMIES))
    sheet.name = "rig.eds"
    return network.add_node(NODE, sheet)  # type: ignore[arg-type]


def test_sdo_transfers_of_all_kinds() -> None:
    node = CanopenNode(parse_eds(RICH), NODE)

    def client(network: canopen.Network) -> None:
        sdo = remote_node(network).sdo
        sdo[0x2006].raw = 0x1234
        assert sdo[0x2006].raw == 0x1234
        assert sdo[0x1008].raw == "a node for tests"
        sdo[0x2004].raw = "segment by segment"
        assert sdo[0x2004].raw == "segment by segment"
        for crc in (True, False):
            blob = BLOB + bytes([crc])
            with sdo[0x2009].open("wb", size=len(blob), block_transfer=True, request_crc_support=crc) as file:
                file.write(blob)
            # Not without CRC: the client then checks the field although it announced no CRC, and the field is 0.
            with sdo[0x2009].open("rb", block_transfer=True) as file:
                assert file.read() == blob
        for index, code in ((0x2003, 0x06010001), (0x3000, 0x06020000)):
            with pytest.raises(canopen.SdoAbortedError) as refused:
                sdo.upload(index, 0)
            assert refused.value.code == code

    with_client([node], client)
    assert node.data.get(0x2009) == BLOB + b"\0"


def test_nmt_pdo_and_emcy() -> None:
    node = CanopenNode(parse_eds(RICH), NODE)

    def client(network: canopen.Network) -> None:
        remote = remote_node(network)
        remote.sdo[0x1017].raw = 20
        assert remote.nmt.wait_for_heartbeat(timeout=5) == "PRE-OPERATIONAL"
        remote.tpdo.read()
        remote.rpdo.read()
        remote.tpdo[1].event_timer = 10
        remote.tpdo[1].save()
        remote.nmt.state = "OPERATIONAL"
        remote.rpdo[1][0].raw = -7
        remote.rpdo[1][1].raw = 200
        remote.rpdo[1].transmit()
        while remote.tpdo[1].wait_for_reception(timeout=5) is not None and remote.tpdo[1][0].raw != -7:
            pass
        assert remote.tpdo[1][0].raw == -7
        assert remote.sdo[0x2001].raw == 200
        network.send_message(0x200 + NODE, b"\x01")
        error = remote.emcy.wait(0x8210, timeout=5)
        assert error is not None
        assert error.register == 0x11
        assert remote.sdo[0x1003][1].raw == 0x8210
        remote.nmt.state = "RESET COMMUNICATION"
        remote.nmt.wait_for_bootup(timeout=5)

    with_client([node], client)
    assert node.state is NmtState.PRE_OPERATIONAL


def test_lss_fastscan_finds_the_node_without_an_id() -> None:
    """CO-057: the node without an ID is found and gets one; nodes with an ID do not respond."""
    factory = {(0x1018, sub): part.to_bytes(4, "little") for sub, part in ((1, 1), (2, 2), (3, 4), (4, 0x80000000))}
    nodes = [
        CanopenNode(parse_eds(RICH), UNCONFIGURED, NodeContext(factory=factory)),
        CanopenNode(parse_eds(RICH), 99),
    ]

    def client(network: canopen.Network) -> None:
        lss: Any = network.lss
        lss.RESPONSE_TIMEOUT = 0.3  # five times without an answer; on a loaded host an answer takes longer
        assert lss.fast_scan() == (True, [1, 2, 4, 0x80000000])
        assert lss.inquire_node_id() == UNCONFIGURED
        lss.configure_node_id(10)
        lss.store_configuration()
        lss.send_switch_state_global(lss.WAITING_STATE)
        assert lss.fast_scan() == (False, None)
        assert lss.send_switch_state_selective(1, 2, 4, 0x80000000)
        assert lss.inquire_node_id() == 10

    with_client(nodes, client)
    assert [node.node_id for node in nodes] == [10, 99]
    assert [node.state for node in nodes] == [NmtState.PRE_OPERATIONAL] * 2
