"""Connections: the data stream of the paper (docs/explanation/paper.md), and the asynchronous connection ends that contain it.

`Connection` follows the paper's schema exactly: a protocol type and a FIFO of data that is empty after Init, appended to by
`write`, and read from its head. Drivers and devices hold a `ByteConnection` or a `CanConnection`: one end of a duplex
medium (paper.md, ruling 4), whose inbound direction is such a stream. The ends for ports and sockets of the operating
system (fieldtwin.gateway.connections), the ends for emulators (fieldtwin.emulators.endpoints) and ends in memory differ only in
the source of their data.

Only a `Connector` opens a port, socket or bus. The runtime is given a `Connector`, and a driver does not know whether
it leads to a real device or to an emulator.
"""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine
from enum import Enum
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.concurrency.timeout import ring, start_timeout
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Bug, ConnectionLost, FieldtwinError


class PROTOCOL(Enum):
    """The paper's PROTOCOL type: the kind of link. CAN is an addition of this project (paper.md, ruling 13)."""

    RS232 = "RS232"
    TCP = "TCP"
    CAN = "CAN"


T = TypeVar("T", bytes, CanFrame)


class Connection(ABC, Generic[T]):
    """The paper's Connection: a typed FIFO that neither loses, changes nor invents data.

    Abstract: a device or driver owns an RS232, TCP or CAN connection, never this class.
    """

    type: ClassVar[PROTOCOL]

    def __init__(self) -> None:
        if not hasattr(type(self), "type"):
            raise Bug("an abstract Connection was made", expected="RS232Connection, TCPConnection or CANConnection")
        self.data_stream: deque[T] = deque()

    def write(self, value: T) -> None:
        """Append `value` to the stream."""
        self.data_stream.append(value)

    def read(self) -> T:
        """Take the head of the stream. The stream must not be empty."""
        if not self.data_stream:
            raise Bug("read from an empty connection", expected="a non-empty data stream", where=self.type.value)
        return self.data_stream.popleft()


class RS232Connection(Connection[bytes]):
    """A serial line."""

    type = PROTOCOL.RS232


class TCPConnection(Connection[bytes]):
    """A TCP stream."""

    type = PROTOCOL.TCP


class CANConnection(Connection[CanFrame]):
    """One node's view of a CAN bus: a broadcast medium, not a pipe."""

    type = PROTOCOL.CAN


class _End(Generic[T]):
    """The inbound half of a connection end: the code that receives from the medium calls `feed`, and the reader awaits `_next`.

    At most `max_pending` items wait. `feed` returns False when that limit is reached, and the caller of `feed` then stops reading
    from the operating system. `on_room` is called when there is room for another item.
    """

    def __init__(self, inbound: Connection[T], endpoint: Endpoint, max_pending: int) -> None:
        self.inbound: Connection[T] = inbound
        self._stream: deque[T] = inbound.data_stream  # the same object: its `write` and `read` are append and popleft
        self.endpoint = endpoint
        self.max_pending = max_pending
        self.on_arrival: Callable[[T], None] | None = None
        """A function (such as a tap) that is called with every item when it arrives, whether or not the item is read later. It
        must not call `feed`, read from the connection, or raise.
        """
        self.intercept: Callable[[T], bool] | None = None
        """A function that is called with each item before any other code sees it. It returns True if it took the item, and may
        then pass it on with `feed_through`.
        """
        self.local = ""
        """The local address, ``HOST:PORT``, if the medium has such addresses."""
        self._lost: FieldtwinError | None = None
        self._waiter: asyncio.Future[None] | None = None

    @property
    def lost(self) -> FieldtwinError | None:
        """Return why the connection ended, or None while it is open."""
        return self._lost

    def feed(self, item: T) -> bool:
        """Take an item that arrived. Return False if the receiver should stop reading from the medium for now."""
        if self.intercept is not None and self.intercept(item):
            return len(self._stream) < self.max_pending
        return self.feed_through(item)

    def feed_through(self, item: T) -> bool:
        """Take an item like `feed`, but do not pass it to `intercept`."""
        self._stream.append(item)
        if self.on_arrival is not None:
            self.on_arrival(item)
        waiter = self._waiter
        if waiter is not None and not waiter.done():
            waiter.set_result(None)
        return len(self._stream) < self.max_pending

    def feed_lost(self, error: FieldtwinError) -> None:
        """Record that the medium is gone. Items that arrived before are still read first. The first reason is kept."""
        if self._lost is None:
            self._lost = error
            self._wake()

    def on_room(self) -> None:
        """Resume reading from the medium if it was paused. Called after a consumer took an item."""

    def _loss(self) -> FieldtwinError:
        """Return a new error with the reason why the connection ended. Each `raise` needs a new error, because a reused one
        collects tracebacks and locations.
        """
        kept = self._lost or closed_locally(self.endpoint)
        fresh = type(kept).__new__(type(kept))
        fresh.args = kept.args
        fresh.__dict__.update(kept.__dict__)
        return fresh

    def _wake(self) -> None:
        if self._waiter is not None:
            ring(self._waiter)

    async def _next(self) -> T:
        while not self._stream:
            waiter = self._waits(asyncio.get_running_loop().create_future())
            try:
                await waiter
            finally:
                self._waiter = None
        return self._taken()

    async def _next_within(self, timeout_s: float, nothing: T) -> T:
        """Return the next item like `_next`, or `nothing` if none arrives within `timeout_s`."""
        if not self._stream:
            waiter, end = start_timeout(asyncio.get_running_loop(), timeout_s)
            try:
                self._waits(waiter)
                await waiter
            finally:
                if self._waiter is waiter:
                    self._waiter = None
                if end is not None:
                    end()
            if not self._stream:
                if self._lost is not None:
                    raise self._loss()
                return nothing
        return self._taken()

    def _taken(self) -> T:
        item = self._stream.popleft()
        self.on_room()
        return item

    def _waits(self, waiter: asyncio.Future[None]) -> asyncio.Future[None]:
        """Register `waiter`, which completes when an item arrives or the medium is lost. Raises if it is already lost."""
        if self._lost is not None:
            raise self._loss()
        if self._waiter is not None:
            raise Bug("two readers on one connection", where=str(self.endpoint))
        self._waiter = waiter
        return waiter


class ByteConnection(_End[bytes], ABC):
    """One end of a byte stream (serial line or socket). One reader at a time.

    `feed` gets chunks as the medium delivered them. Their boundaries have no meaning for a protocol.
    """

    def __init__(self, inbound: Connection[bytes], endpoint: Endpoint, max_pending: int = 1024) -> None:
        super().__init__(inbound, endpoint, max_pending)

    @property
    def type(self) -> PROTOCOL:
        return self.inbound.type

    def read(self) -> Coroutine[Any, Any, bytes]:
        """Return the next chunk, never empty. Raises `ConnectionLost` once the peer is gone and everything has been
        read.
        """
        return self._next()

    def read_within(self, timeout_s: float) -> Coroutine[Any, Any, bytes]:
        """Return the next chunk, or an empty one if none arrives within `timeout_s`.

        Raises as `read`. It costs less than `read` with a timeout around it.
        """
        return self._next_within(timeout_s, b"")

    def read_pending(self) -> bytes:
        """Return everything that arrived and was not read yet, possibly empty. Never waits."""
        if not self._stream:
            return b""
        chunks = []
        while self._stream:
            chunks.append(self._stream.popleft())
        self.on_room()
        return b"".join(chunks)

    @abstractmethod
    async def write(self, data: bytes) -> None:
        """Pass `data` to the medium, waiting while its buffer is full. Raises `ConnectionLost`."""

    @abstractmethod
    async def aclose(self) -> None:
        """Close the connection; afterwards `read` raises. Closing twice does nothing."""


class Client(ByteConnection):
    """The connection of a client that connected to a local listener.

    `peer` is the client's address. `role` is the role that its certificate names (MBTLS 8.4), or empty.
    """

    peer: str
    peer_port: int
    role: str


class Clients(Protocol):
    """The interface of a listener: its accepted clients, oldest first, and counts of the clients that it did not accept."""

    accepted: int
    evicted: int
    refused: int
    unshaken: int
    retired: int

    @property
    def bound(self) -> Endpoint:
        """Return the endpoint with the actual port, which matters if port 0 was requested."""
        ...

    @property
    def clients(self) -> tuple[Client, ...]: ...

    async def aclose(self) -> None:
        """Stop listening and close every client."""
        ...


Listen = Callable[
    [Endpoint, Callable[[Client], Awaitable[None]], int, Callable[[str], bool], float], Awaitable[Clients]
]
"""A function that starts to listen: ``listen(endpoint, on_client, max_clients, admits, idle_s)``. Raises `EndpointBusy` or
`Unreachable`.
"""


class CanConnection(_End[CanFrame], ABC):
    """One node's end of a CAN bus. One reader at a time. A node does not receive its own frames."""

    def __init__(self, inbound: CANConnection, endpoint: Endpoint, max_pending: int = 4096) -> None:
        super().__init__(inbound, endpoint, max_pending)
        self.overruns = 0
        """Frames dropped because the reader was too slow: a bus does not wait for its readers."""
        self.accept: Callable[[CanFrame], bool] | None = None
        """The reader's acceptance filter, if it has one. A frame that it rejects is not stored and does not count as an
        overrun.
        """

    def feed(self, item: CanFrame) -> bool:
        if self.accept is not None and not self.accept(item):
            return True
        if len(self.inbound.data_stream) >= self.max_pending:
            self.overruns += 1
            self.on_overrun(item)
            return False
        return super().feed(item)

    def on_overrun(self, item: CanFrame) -> None:
        """Handle a frame that was dropped because the reader was too slow."""

    def recv(self) -> Coroutine[Any, Any, CanFrame]:
        """Return the next frame. Raises `ConnectionLost` once the bus is gone and everything has been read."""
        return self._next()

    @abstractmethod
    async def send(self, frame: CanFrame) -> None:
        """Queue `frame` for transmission, waiting while the transmit queue is full. Raises `ConnectionLost`."""

    @abstractmethod
    async def aclose(self) -> None:
        """Leave the bus. Closing twice does nothing."""


class Connector(Protocol):
    """The interface that opens connections to endpoints. No other code opens ports, sockets or buses of devices.

    Raises `Unreachable` (or `EndpointBusy`) if the endpoint does not answer, and `UsageError` if this connector does
    not know its kind.
    """

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        """Open a serial port or a socket."""
        ...

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        """Join a CAN bus that runs at `bitrate` bit/s. If the medium knows its bit rate, a different one is refused."""
        ...


class Direction(Enum):
    """The direction of a transfer, as seen from the gateway."""

    SENT = "sent"
    RECEIVED = "received"


class Tap(Protocol):
    """An observer of the traffic of a Connector (recorder, capture). It must not change, delay or drop anything.

    `t_ns` is monotonic. `endpoint` is the device's endpoint in the plant, even if the connection leads to an emulator.
    """

    def on_bytes(self, endpoint: Endpoint, direction: Direction, t_ns: int, data: bytes) -> None: ...

    def on_frame(self, endpoint: Endpoint, direction: Direction, t_ns: int, frame: CanFrame) -> None: ...


def closed_locally(endpoint: Endpoint) -> ConnectionLost:
    """Return the error that `read` raises after the local side has called `aclose`."""
    return ConnectionLost("the connection was closed on this side", where=str(endpoint))
