"""The client side of the software CAN bus as a `CanConnection` on asyncio.

The bus is a TCP server; a frame is a record of 24 bytes (gateway/core/canframe.py). This module does not know how the
server models the bus, or which other nodes are on it.
"""

from __future__ import annotations

import asyncio
from typing import cast

from msgspec.structs import replace

from fieldtwin.gateway.connections.can.soft_bus_hello import Welcome, ask, read_answer
from fieldtwin.gateway.connections.sockets.addresses import address_of
from fieldtwin.gateway.core.canframe import RECORD_SIZE, CanFrame, pack_record, unpack_record
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.connection import CANConnection, CanConnection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, Desync, FieldtwinError, Unreachable, UsageError, os_reason

OPEN_TIMEOUT_S = 5.0
CLOSE_TIMEOUT_S = 1.0


class SoftBusConnection(CanConnection):
    """One node on a software CAN bus; create it with `open`.

    The `t_ns` of a received frame is the exact time at which it ended on the bus, on this host's monotonic clock. Error frames
    among them report the state of this node's controller (gateway/core/can_error.py).
    """

    def __init__(self, endpoint: Endpoint, max_pending: int = 4096) -> None:
        super().__init__(CANConnection(), endpoint, max_pending)
        self.bitrate = 0
        self.confirmed = 0
        """Own frames that the bus reported as sent."""
        self._wire: _Wire | None = None
        self._window = 1
        self._in_flight = 0
        self._offset_ns = 0
        self._turn = asyncio.Lock()  # keeps the order of concurrent senders
        self._progress = asyncio.Event()

    @classmethod
    async def open(cls, endpoint: Endpoint, bitrate: int, *, max_pending: int = 4096) -> SoftBusConnection:
        """Join the bus at ``can:fieldtwin/HOST:PORT``, which must run at `bitrate` bit/s (0: any bit rate).

        Raises `Unreachable` if the endpoint does not answer or is not a bus, `UsageError` if it runs at a different bit
        rate, `EndpointBusy` if it is full.
        """
        host, port = endpoint.address
        where = str(endpoint)
        connection = cls(endpoint, max_pending)
        loop = asyncio.get_running_loop()
        wire = _Wire(connection)
        try:
            async with asyncio.timeout(OPEN_TIMEOUT_S):
                await loop.create_connection(lambda: wire, host, port)
                asked_ns = _loop_ns(loop)
                wire.write(ask(bitrate, confirmations=True))
                answer, answered_ns = await wire.answer
            welcome = read_answer(answer, bitrate, where)
        except TimeoutError as e:
            await wire.aclose()
            raise Unreachable(f"no answer within {OPEN_TIMEOUT_S:g} s", where=where) from e
        except OSError as e:
            raise not_reached(e, where) from e
        except BaseException:
            await wire.aclose()
            raise
        connection._join(wire, welcome, welcome.clock_offset_ns(asked_ns, answered_ns))
        return connection

    def _join(self, wire: _Wire, welcome: Welcome, offset_ns: int) -> None:
        self._wire = wire
        self.bitrate = welcome.bitrate
        self._window = welcome.window
        self._offset_ns = offset_ns
        wire.take_frames()

    async def send(self, frame: CanFrame) -> None:
        """Pass `frame` to the bus's transmit queue, waiting while it is full. Raises `ConnectionLost`.

        A node has at most the bus's transmit window of unconfirmed frames outstanding, so a new frame does not wait behind
        many older frames in socket buffers.
        """
        if frame.error:
            raise UsageError("an error frame cannot be sent", got=str(frame), where=str(self.endpoint))
        async with self._turn:
            while self._lost is None and self._in_flight >= self._window:
                self._progress.clear()
                await self._progress.wait()
            if self._lost is not None:
                raise self._loss()
            assert self._wire is not None
            self._in_flight += 1
            self._wire.write(pack_record(frame))

    async def aclose(self) -> None:
        """Leave the bus after it has sent the frames passed to it (waiting at most `CLOSE_TIMEOUT_S`)."""
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT_S):
                while self._lost is None and self._in_flight:
                    self._progress.clear()
                    await self._progress.wait()
        except TimeoutError:
            pass  # the bus is slow and sends the rest later
        self.feed_lost(closed_locally(self.endpoint))
        self._progress.set()
        self.inbound.data_stream.clear()
        if self._wire is not None:
            await self._wire.aclose()

    def on_record(self, record: bytes) -> None:
        """Handle one record from the bus. Raises `Desync` if it is invalid."""
        frame, confirmed = unpack_record(record)
        if confirmed:
            self.confirmed += 1
            self._in_flight -= 1
            self._progress.set()
        elif self._lost is None:
            self.feed(replace(frame, t_ns=frame.t_ns + self._offset_ns) if self._offset_ns else frame)

    def on_lost(self, error: FieldtwinError) -> None:
        """Record that the connection to the bus ended because of `error`, and wake a waiting `send`."""
        self.feed_lost(error)
        self._progress.set()


class _Wire(asyncio.Protocol):
    """The TCP connection to the bus. It cuts the stream into records. The first record answers the request to join."""

    def __init__(self, connection: SoftBusConnection) -> None:
        loop = asyncio.get_running_loop()
        self._connection = connection
        self._loop = loop
        self._buffer = bytearray()
        self._joined = False
        self._transport: asyncio.Transport | None = None
        self.answer: asyncio.Future[tuple[bytes, int]] = loop.create_future()
        self._gone: asyncio.Future[None] = loop.create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        # uvloop's transport has the same methods, but a different base class
        transport = cast(asyncio.Transport, transport)
        self._transport = transport
        self._connection.local = address_of(transport)

    def data_received(self, data: bytes) -> None:
        self._buffer += data
        if not self.answer.done() and len(self._buffer) >= RECORD_SIZE:
            self.answer.set_result((bytes(self._buffer[:RECORD_SIZE]), _loop_ns(self._loop)))
            del self._buffer[:RECORD_SIZE]
        if self._joined:
            self.take_frames()

    def take_frames(self) -> None:
        """Deliver the complete records received so far, and from now on each record as it arrives."""
        self._joined = True
        whole = len(self._buffer) - len(self._buffer) % RECORD_SIZE
        records = bytes(self._buffer[:whole])
        del self._buffer[:whole]
        try:
            for start in range(0, whole, RECORD_SIZE):
                self._connection.on_record(records[start : start + RECORD_SIZE])
        except Desync as e:
            self._connection.on_lost(
                ConnectionLost(f"the software CAN bus violated its protocol: {e}", where=self._where())
            )
            self._abort()

    def connection_lost(self, exc: Exception | None) -> None:
        reason = f"the software CAN bus is gone: {exc}" if exc else "the software CAN bus closed"
        error = ConnectionLost(reason, where=self._where())
        if not self.answer.done():
            # The server is not a bus, or a bus that is closing; neither can be used.
            self.answer.set_result((bytes(self._buffer), 0))
        self._connection.on_lost(error)
        if not self._gone.done():
            self._gone.set_result(None)

    def write(self, data: bytes) -> None:
        assert self._transport is not None
        self._transport.write(data)

    async def aclose(self) -> None:
        if self._transport is None:
            return
        self._transport.close()
        await asyncio.wait([self._gone], timeout=CLOSE_TIMEOUT_S)
        self._abort()
        await asyncio.wait([self._gone])

    def _abort(self) -> None:
        if self._transport is not None:
            self._transport.abort()

    def _where(self) -> str:
        return str(self._connection.endpoint)


def not_reached(error: OSError, where: str) -> Unreachable:
    """Return the error of a client that could not open a socket to the bus."""
    return Unreachable(
        f"cannot reach the software CAN bus: {os_reason(error)}", where=where, hint="start one: fieldtwin can-bus"
    )


def _loop_ns(loop: asyncio.AbstractEventLoop) -> int:
    return int(loop.time() * NS_PER_S)
