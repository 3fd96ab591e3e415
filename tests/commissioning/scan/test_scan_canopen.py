"""`scan` of a CANopen bus in virtual time: nodes found by listening, nodes found by requests, and when it sends nothing."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest
from canopen_peer_node import PeerBus, PeerNode, closing
from canopen_slave_rig import unnamed
from commissioning_rig import can_bus, loop, run_virtually
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.commissioning.scan.can_listener import BusListener
from fieldtwin.commissioning.scan.canopen import CanScan, CanScanner, CanScanOptions
from fieldtwin.gateway.connections.can.facts import CanFacts
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CanConnection, Connector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.protocols.canopen.configure import Identity
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtState

URL = "can:fieldtwin/h:1"
U32 = (0x00020192).to_bytes(4, "little")
WHOLE = {(0x1000, 0): U32, (0x1018, 0): b"\x01", (0x1018, 1): (2).to_bytes(4, "little")}


async def scan(connector: Connector, url: str = URL, facts: CanFacts | None = None, **options: object) -> CanScan:
    made = CanScanOptions(**options)  # type: ignore[arg-type]
    known = facts or CanFacts("fieldtwin")
    return await CanScanner(url, made, connector=connector, clock=loop(), facts=lambda _: known).run()


def test_a_silent_bus_is_asked_and_nothing_but_reads_is_sent() -> None:
    async def main() -> None:
        nodes = [PeerNode(3, WHOLE), PeerNode(9, {})]
        peers = PeerBus(nodes)
        async with closing(peers):
            for node in nodes:
                node.power_on()
            found = await scan(peers, lss=False)
        assert [(n.node, n.answers, n.identity) for n in found.nodes] == [
            (3, True, Identity(0x00020192, 2, None, None, None)),
            (9, True, None),
        ]
        assert peers.writes() == []
        assert found.took_s >= 5 + 127 * 0.1

    run_virtually(main())


def test_with_traffic_a_scan_only_listens_without_permission() -> None:
    async def main() -> None:
        nodes = [PeerNode(3, WHOLE, heartbeat_s=0.5), PeerNode(9, WHOLE)]
        peers = PeerBus(nodes)
        async with closing(peers):
            for node in nodes:
                node.power_on()
            found = await scan(peers)
            assert peers.sent == []
            assert not found.sent
            heard = found.heard.nodes[3]
            assert (heard.state, round(heard.period_s, 3)) == (NmtState.PRE_OPERATIONAL, 0.5)
            assert any("--share-bus" in note for note in found.notes)
            shared = await scan(peers, share_bus=True, lss=False)
        assert [n.node for n in shared.nodes] == [3, 9]

    run_virtually(main())


def test_a_node_that_another_master_uses_is_not_asked() -> None:
    async def main() -> None:
        nodes = [PeerNode(3, WHOLE), PeerNode(9, WHOLE)]
        peers = PeerBus(nodes)

        async def other_master() -> None:
            while True:
                if nodes[0].end is not None:
                    nodes[0].end.peer.feed(CanFrame(0x603, bytes.fromhex("4000100000000000")))
                await asyncio.sleep(2)

        async with closing(peers):
            for node in nodes:
                node.power_on()
            talking = asyncio.ensure_future(other_master())
            found = await scan(peers, share_bus=True, nodes=(2, 3, 9), lss=False)
            talking.cancel()
        assert found.blocked == [3]
        assert 0x603 not in [f.can_id for f in peers.sent]
        assert [n.node for n in found.nodes] == [9]

    run_virtually(main())


def test_error_frames_alone_mean_the_wrong_bit_rate_and_nothing_is_sent() -> None:
    async def main() -> None:
        peers = PeerBus()
        async with closing(peers):
            task = asyncio.ensure_future(scan(peers))
            await asyncio.sleep(1)
            assert peers.ours is not None
            peers.ours.feed(CanFrame(0x88, bytes(8), error=True))
            found = await task
        assert peers.sent == []
        assert any("bit rate is wrong" in note for note in found.notes)

    run_virtually(main())


def test_nodes_without_an_id_are_found_by_fastscan_and_left_waiting() -> None:
    async def main() -> None:
        async with can_bus(unnamed((1, 2, 3, 7)), unnamed((1, 2, 3, 9))) as connector:
            found = await scan(connector, nodes=(1, 2))
            assert [a.serial for a in found.unconfigured] == [7, 9]
            await asyncio.sleep(0.1)  # our last frame leaves
            again = await scan(connector, nodes=())
            assert [a.serial for a in again.unconfigured] == [7, 9], "they wait again, and can be found again"

    run_virtually(main())


class Adapter:
    """An adapter whose bus runs at `rate`: at a different rate nothing is received."""

    def __init__(self, peers: PeerBus, rate: int) -> None:
        self.peers, self.rate = peers, rate
        self.opened: list[tuple[int, str]] = []

    async def open_bytes(self, endpoint: Endpoint) -> object:
        raise AssertionError

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        self.opened.append((bitrate, endpoint.param("listen")))
        if bitrate == self.rate:
            return await self.peers.open_can(endpoint, bitrate)
        return await PeerBus().open_can(endpoint, bitrate)


@pytest.mark.parametrize("share", [False, True])
def test_an_adapter_finds_the_bit_rate_without_acknowledging(share: bool) -> None:
    async def main() -> None:
        node = PeerNode(3, WHOLE, heartbeat_s=0.3)
        peers = PeerBus([node])
        adapter = Adapter(peers, 500_000)
        facts = CanFacts("slcan", needs_bitrate=True, can_listen_only=True)
        async with closing(peers):
            node.power_on()
            found = await scan(adapter, "can:slcan/x", facts, share_bus=share, nodes=(3,), lss=False)  # type: ignore[arg-type]
        assert found.bitrate == 500_000
        assert [b for b, listen in adapter.opened if listen] == [125_000, 250_000, 500_000, 500_000]
        assert [b for b, listen in adapter.opened if not listen] == ([500_000] if share else [])
        silent = Adapter(PeerBus(), 0)
        nothing = await scan(silent, "can:slcan/x", facts)  # type: ignore[arg-type]
        assert not nothing.sent
        assert all(listen for _, listen in silent.opened)
        for task in asyncio.all_tasks() - {asyncio.current_task()}:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    run_virtually(main())


def test_a_listen_only_interface_is_never_asked_to_send() -> None:
    async def main() -> None:
        peers = PeerBus()
        async with closing(peers):
            found = await scan(peers, facts=replace(CanFacts("socketcan", bitrate=125_000), listen_only=True))
        assert peers.sent == []
        assert any("listen-only" in note for note in found.notes)

    run_virtually(main())


FRAMES = st.builds(CanFrame, st.integers(0, 0x7FF), st.binary(max_size=8), remote=st.just(False))


@given(st.lists(FRAMES, max_size=50))
@settings(max_examples=60, deadline=None)
def test_listening_to_anything_never_fails(frames: list[CanFrame]) -> None:
    listener = BusListener()
    for i, frame in enumerate(frames):
        listener.feed(frame, i * 1_000_000)
    assert listener.heard.frames == len(frames)
    assert all(1 <= n <= 127 for n in listener.heard.nodes)


def test_a_master_that_was_silent_for_long_ends_the_asking() -> None:
    async def main() -> None:
        peers = PeerBus([PeerNode(100, WHOLE)])
        async with closing(peers):
            task = asyncio.ensure_future(scan(peers))
            await asyncio.sleep(8)
            assert peers.ours is not None
            peers.ours.feed(CanFrame(0x000, b"\x01\x00"))
            found = await task
        assert 0 < found.asked < 50
        assert any("started to send" in note for note in found.notes)
        assert found.took_s < 9

    run_virtually(main())
