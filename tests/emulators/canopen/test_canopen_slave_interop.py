"""The emulated node and a third-party client: the `canopen` package over python-can's virtual bus, in real time."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import uuid

import can
import canopen
import pytest
from canopen_slave_rig import INCLINOMETER
from support import eventually, run

from fieldtwin.emulators.canopen.eds.dictionary import load_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NmtState, NodeContext
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CANConnection, CanConnection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost
from fieldtwin.gateway.wallclock import WallClock


class VirtualEnd(CanConnection):
    """An end of python-can's in-process bus; its reader thread hands frames to the loop."""

    def __init__(self, channel: str) -> None:
        super().__init__(CANConnection(), Endpoint("can", path=channel, interface="virtual"))
        self._bus = can.Bus(interface="virtual", channel=channel)
        self._loop = asyncio.get_running_loop()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        while not self._closing.is_set():
            message = self._bus.recv(timeout=0.05)
            if message is not None:
                data = b"" if message.is_remote_frame else bytes(message.data)
                frame = CanFrame(
                    message.arbitration_id, data, extended=message.is_extended_id, remote=message.is_remote_frame
                )
                self._loop.call_soon_threadsafe(self.feed, frame)

    async def send(self, frame: CanFrame) -> None:
        self._bus.send(can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=frame.extended))

    async def aclose(self) -> None:
        self._closing.set()
        await asyncio.to_thread(self._thread.join)
        self._bus.shutdown()
        self.feed_lost(closed_locally(self.endpoint))


def test_the_canopen_package_s_client() -> None:
    slopes = {(0x6010, 0): (-1500).to_bytes(2, "little", signed=True), (0x6020, 0): (250).to_bytes(2, "little")}

    def client(channel: str) -> list[tuple[float, float]]:
        network = canopen.Network()
        network.connect(interface="virtual", channel=channel)
        try:
            remote = network.add_node(5, str(INCLINOMETER))
            assert remote.sdo[0x1008].raw == "fieldtwin reference inclinometer"
            assert remote.sdo[0x1000].raw == 0x0002019A
            remote.sdo[0x1017].raw = 50
            assert remote.sdo[0x1017].raw == 50
            assert remote.nmt.wait_for_heartbeat(timeout=5) == "PRE-OPERATIONAL"
            with pytest.raises(canopen.SdoAbortedError) as refused:
                remote.sdo[0x6010].raw = 1
            assert refused.value.code == 0x06010002
            remote.tpdo.read()
            assert [variable.name for variable in remote.tpdo[1]] == ["Slope long16", "Slope lateral16"]
            remote.tpdo[1].event_timer = 20
            remote.tpdo[1].save()
            remote.nmt.state = "OPERATIONAL"
            seen = []
            for _ in range(5):
                assert remote.tpdo[1].wait_for_reception(timeout=5) is not None
                seen.append((remote.tpdo[1]["Slope long16"].raw, remote.tpdo[1]["Slope lateral16"].raw))
            remote.nmt.state = "RESET"
            remote.nmt.wait_for_bootup(timeout=5)
            assert remote.sdo[0x1017].raw == 0
            return seen
        finally:
            network.disconnect()

    async def main() -> None:
        channel = uuid.uuid4().hex
        end = VirtualEnd(channel)
        node = CanopenNode(load_eds(INCLINOMETER), 5, NodeContext(source=lambda now_ns: slopes))
        serving = asyncio.create_task(serve_node(end, node, WallClock()))
        try:
            await eventually(lambda: node.state is NmtState.PRE_OPERATIONAL)
            seen = await asyncio.to_thread(client, channel)
        finally:
            serving.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await serving
            await end.aclose()
        assert seen == [(-1500, 250)] * 5
        assert node.counters.sdo_requests == node.counters.sdo_replies > 10
        assert node.counters.tpdos >= 5

    run(main())


def test_a_lost_bus_ends_the_service() -> None:
    async def main() -> None:
        end = VirtualEnd(uuid.uuid4().hex)
        node = CanopenNode(load_eds(INCLINOMETER), 5)
        serving = asyncio.create_task(serve_node(end, node, WallClock()))
        await eventually(lambda: node.state is NmtState.PRE_OPERATIONAL)
        await end.aclose()
        with pytest.raises(ConnectionLost):
            await serving

    run(main())
