"""A CANopen node for tests of the gateway: objects of 1 to 4 bytes over SDO, NMT, a heartbeat, and the recorded writes.

It is small and checks nothing on purpose. `stored` survives a power cycle. On a bus in memory, in virtual time.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from contextlib import asynccontextmanager

from canopen_master_bus import MemoryEnd, bus

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable

Objects = dict[tuple[int, int], bytes]


class PeerNode:
    """Call `power_on` once it is on a bus; `power_off` removes it."""

    def __init__(self, node: int, objects: Objects, *, heartbeat_s: float = 0.0) -> None:
        self.node, self.factory, self.heartbeat_s = node, objects, heartbeat_s
        self.stored: Objects = {}
        self.objects: Objects = {}
        self.writes: list[tuple[int, int, str]] = []
        self.state = 0
        self.end: MemoryEnd | None = None
        self._beat: asyncio.TimerHandle | None = None

    def power_on(self) -> None:
        self.objects = self.factory | self.stored
        self.say(0x700, b"\0")
        self.state = 0x7F
        self._next_beat()

    def power_off(self) -> None:
        self.state = 0
        if self._beat is not None:
            self._beat.cancel()

    def say(self, base: int, data: bytes) -> None:
        if self.end is not None:
            now_ns = round(asyncio.get_running_loop().time() * 1e9)
            self.end.peer.feed(CanFrame(base + self.node, data, t_ns=now_ns))

    def take(self, frame: CanFrame) -> None:
        if not self.state:
            return
        if frame.can_id == 0 and frame.data[1] in (0, self.node):
            self.command(frame.data[0])
        elif frame.can_id == 0x600 + self.node and self.state != 4:
            self.request(frame.data)

    def command(self, command: int) -> None:
        if command in (0x81, 0x82):
            self.power_off()
            self.power_on()
        else:
            self.state = {1: 0x05, 2: 0x04, 0x80: 0x7F}[command]
            self.say(0x700, bytes([self.state]))

    def request(self, data: bytes) -> None:
        place, multiplexor = (int.from_bytes(data[1:3], "little"), data[3]), data[1:4]
        if data[0] == 0x80:
            return
        value = self.objects.get(place)
        if value is None:
            self.say(0x580, b"\x80" + multiplexor + (0x0602_0000).to_bytes(4, "little"))
        elif data[0] == 0x40:
            self.say(0x580, bytes([0x43 | (4 - len(value)) << 2]) + multiplexor + value.ljust(4, b"\0"))
        else:
            written = data[4 : 8 - (data[0] >> 2 & 3)]
            self.writes.append((*place, written.hex()))
            self.objects[place] = written
            if place == (0x1010, 1):
                self.stored = {k: v for k, v in self.objects.items() if k != place}
            self.say(0x580, b"\x60" + multiplexor + bytes(4))

    def _next_beat(self) -> None:
        if self.heartbeat_s:
            self._beat = asyncio.get_running_loop().call_later(self.heartbeat_s, self._on_beat)

    def _on_beat(self) -> None:
        if self.state:
            self.say(0x700, bytes([self.state]))
            self._next_beat()


class PeerBus:
    """A `Connector` whose only bus has these nodes. `sent` has the gateway's frames. `gone`: the bus cannot be opened."""

    def __init__(self, nodes: Iterable[PeerNode] = (), *, others: Iterable[object] = ()) -> None:
        self.nodes = list(nodes)
        self.listeners = list(others)
        self.sent: list[CanFrame] = []
        self.gone = False
        self.ours: MemoryEnd | None = None
        self._tasks: list[asyncio.Task[None]] = []

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        if self.gone:
            raise Unreachable("no bus", where=str(endpoint))
        self.ours, theirs = bus()
        for node in self.nodes:
            node.end = theirs
        self._tasks.append(asyncio.ensure_future(self._serve(theirs)))
        return self.ours

    async def open_bytes(self, endpoint: Endpoint) -> object:
        raise Unreachable("a CAN bus", where=str(endpoint))

    async def _serve(self, theirs: MemoryEnd) -> None:
        while True:
            frame = await theirs.recv()
            self.sent.append(frame)
            for node in self.nodes:
                node.take(frame)
            for listener in self.listeners:
                listener(theirs, frame)  # type: ignore[operator]

    def writes(self) -> list[CanFrame]:
        """Return the gateway's frames that may change a node: NMT, SYNC, TIME, LSS, downloads."""
        return [f for f in self.sent if not (f.can_id & 0x780 == 0x600 and f.data[0] in (0x40, 0x60, 0x70, 0x80))]

    async def aclose(self) -> None:
        for node in self.nodes:
            node.power_off()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)


@asynccontextmanager
async def closing(peers: PeerBus):  # type: ignore[no-untyped-def]
    try:
        yield peers
    finally:
        await peers.aclose()
