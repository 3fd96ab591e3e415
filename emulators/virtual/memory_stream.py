"""Connections in memory: two ends of a byte stream, and the transmission time of the bytes.

Bytes written at one end arrive at the other in order and complete, immediately or after the line's character time.
"""

from __future__ import annotations

import asyncio

from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.emulators.wires.serial_line import SerialPacer
from fieldtwin.gateway.core.connection import (
    Client,
    Connection,
    Direction,
    RS232Connection,
    TCPConnection,
    closed_locally,
)
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError

MAX_PENDING = 1024
SENT = Direction.SENT


class MemoryWire:
    """A connection with two ends. With the `settings` of a serial line, its baud rate applies; with None, bytes take no time."""

    def __init__(
        self,
        loop: VirtualLoop,
        gateway_end: Endpoint,
        field_end: Endpoint,
        settings: SerialSettings | None,
        *,
        serial: bool,
    ) -> None:
        self.loop = loop
        self.serial = serial
        kind = RS232Connection if serial else TCPConnection
        self.near = MemoryEnd(self, Direction.SENT, kind(), gateway_end)
        self.far = MemoryEnd(self, Direction.RECEIVED, kind(), field_end)
        self._sent = SerialPacer(settings) if settings is not None else None
        self._received = SerialPacer(settings) if settings is not None else None

    def write(self, direction: Direction, data: bytes) -> None:
        """Send `data` after the bytes that are already on the wire.

        Bytes written in one piece are delivered when the piece is complete. If they follow earlier bytes without a
        pause, the first character is delivered separately; otherwise the line would seem to be silent.
        """
        if not data:
            return
        receiver, pacer = (self.far, self._sent) if direction is SENT else (self.near, self._received)
        if pacer is None:
            receiver.arrived(data)
            return
        now_ns = self.loop.now_ns
        if pacer.busy_until_ns > now_ns and len(data) > 1:
            self.loop.call_at_ns(pacer.send(now_ns, 1), receiver.arrived, data[:1])
            data = data[1:]
        self.loop.call_at_ns(pacer.send(now_ns, len(data)), receiver.arrived, data)

    def ended(self, direction: Direction) -> None:
        """Close the end that writes in `direction`. The peer is notified after the bytes in transit have arrived."""
        receiver, pacer = (self.far, self._sent) if direction is SENT else (self.near, self._received)
        lost = ConnectionLost("the other side ended the connection", where=str(receiver.endpoint))
        if pacer is None:
            receiver.feed_lost(lost)
        else:
            self.loop.call_at_ns(max(self.loop.now_ns, pacer.busy_until_ns), receiver.feed_lost, lost)

    def cut(self, error: FieldtwinError) -> None:
        """Break the connection for both ends."""
        self.near.cut(error)
        self.far.cut(error)


class MemoryEnd(Client):
    """One end of a connection. `direction` is the direction of its writes, as seen from the gateway."""

    def __init__(self, wire: MemoryWire, direction: Direction, kind: Connection[bytes], endpoint: Endpoint) -> None:
        super().__init__(kind, endpoint, MAX_PENDING)
        self.wire = wire
        self.direction = direction
        self.peer = "127.0.0.1"
        self.peer_port = 0
        self.role = ""
        self._room: asyncio.Future[None] | None = None

    @classmethod
    def again(cls, old: MemoryEnd) -> MemoryEnd:
        """Return a new end that replaces a closed end, for a port that is opened again."""
        return cls(old.wire, old.direction, type(old.inbound)(), old.endpoint)

    def arrived(self, data: bytes) -> None:
        """Receive bytes from the peer; a closed end drops them."""
        if self._lost is None:
            self.feed(data)

    async def write(self, data: bytes) -> None:
        if self._lost is not None:
            raise self._loss()
        wire = self.wire
        wire.write(self.direction, data)
        other = wire.far if self.direction is SENT else wire.near
        while len(other._stream) >= other.max_pending and other._lost is None and self._lost is None:
            other._room = asyncio.get_running_loop().create_future()
            await other._room

    def on_room(self) -> None:
        if self._room is not None and not self._room.done():
            self._room.set_result(None)

    def cut(self, error: FieldtwinError) -> None:
        self.feed_lost(error)
        self.on_room()

    async def aclose(self) -> None:
        """Close the end. On a serial line the peer is not notified."""
        if self.lost is None and not self.wire.serial:
            self.wire.ended(self.direction)
        self.cut(closed_locally(self.endpoint))
        self.inbound.data_stream.clear()
