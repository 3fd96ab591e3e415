"""The node scan: nodes with heartbeats, nodes that answer, and silent ones; one request at a time, with pauses."""

from __future__ import annotations

import asyncio
import itertools

from canopen_master_bus import LoopClock, running
from canopen_peer_node import PeerBus, PeerNode, closing
from modbus_virtual import run_virtually

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.protocols.canopen.configure import Identity
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtState
from fieldtwin.gateway.protocols.canopen.scan import FoundNode, scan_nodes

U32 = (1).to_bytes(4, "little")
WHOLE = {(0x1000, 0): U32, (0x1018, 0): b"\x01", (0x1018, 1): (2).to_bytes(4, "little")}


def test_every_node_is_found_once_and_the_bus_hardly_feels_it() -> None:
    async def main() -> None:
        nodes = [PeerNode(3, WHOLE), PeerNode(7, {}, heartbeat_s=0.5), PeerNode(9, WHOLE, heartbeat_s=0.5)]
        peers = PeerBus(nodes)
        async with closing(peers):
            connection = await peers.open_can(Endpoint.parse("can:fieldtwin/h:1"), 125_000)
            master = CanopenMaster(connection, LoopClock())
            async with running(master):
                for node in nodes:
                    node.power_on()
                nodes[2].state = 0x04  # stopped: sends heartbeats, and answers no SDO
                asked: list[tuple[float, int]] = []
                loop = asyncio.get_running_loop()
                found = await scan_nodes(
                    master,
                    LoopClock(),
                    nodes=range(1, 12),
                    listen_s=1.0,
                    on_progress=lambda n: asked.append((loop.time(), n)),
                )
                nodes[2].state = 0
            identity = Identity(1, 2, None, None, None)
            assert found == (
                FoundNode(3, NmtState.INITIALISING, True, identity),
                FoundNode(7, NmtState.PRE_OPERATIONAL, True, None),
                FoundNode(9, NmtState.STOPPED, False, None),
            )
            assert [n for _, n in asked] == list(range(1, 12))
            assert asked[0][0] >= 1.0
            assert all(b[0] - a[0] >= 0.0199 for a, b in itertools.pairwise(asked))
            assert peers.writes() == []

    run_virtually(main())
