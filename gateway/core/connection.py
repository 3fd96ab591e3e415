"""Connections: the paper's pure stream, and the asynchronous ends that wrap it.

`Connection` is SPEC's schema to the letter: a protocol type and a FIFO of data that is empty after Init, appended to
by `write` and read from its head. `ByteConnection` and `CanConnection` are what drivers and devices hold: one end of
a duplex medium (SPEC ruling 4), whose inbound direction *is* such a stream. An operating-system end
(fieldtwin.gateway.connections), an emulator's end (fieldtwin.emulators.endpoints) and an in-memory one differ only in who feeds
it.

Nobody but a `Connector` opens a wire: the runtime receives one, and no driver knows what stands behind it.
"""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine
from enum import Enum
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from fieldtwin.gateway.core.alarm import alarm, ring
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Bug, ConnectionLost, FieldtwinError


class PROTOCOL(Enum):
    """The paper's PROTOCOL type: what kind of wire it is. CAN is ours (SPEC ruling 13)."""

    RS232 = "RS232"
    TCP = "TCP"
    CAN = "CAN"


T = TypeVar("T", bytes, CanFrame)


class Connection(ABC, Generic[T]):
    """SPEC row Connection: a typed FIFO. Nothing is lost, nothing is changed, nothing is invented.

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
    """Inbound half of an asynchronous end: whoever receives calls `feed`, whoever consumes awaits `_next`.

    Bounded: at most `max_pending` items wait; `feed` returns False when the bound is reached, and the feeder then
    stops reading from the operating system (`on_room` is called when there is room again).
    """

    def __init__(self, inbound: Connection[T], endpoint: Endpoint, max_pending: int) -> None:
        self.inbound: Connection[T] = inbound
        self._stream: deque[T] = inbound.data_stream  # that very one: its `write` and `read` are append and popleft
        self.endpoint = endpoint
        self.max_pending = max_pending
        self.on_arrival: Callable[[T], None] | None = None
        """Told of every item at the moment it arrives, read or not (a tap). It may not feed, read or raise."""
        self.intercept: Callable[[T], bool] | None = None
        """Handed each item before anybody sees it; True: it took the item, and may pass it on with `feed_through`."""
        self.local = ""
        """The address of this end, ``HOST:PORT``, where the medium has such addresses."""
        self._lost: FieldtwinError | None = None
        self._waiter: asyncio.Future[None] | None = None

    @property
    def lost(self) -> FieldtwinError | None:
        """Why the connection ended, or None while it is open."""
        return self._lost

    def feed(self, item: T) -> bool:
        """Something arrived. Returns False when nothing more should be taken from the medium for now."""
        if self.intercept is not None and self.intercept(item):
            return len(self._stream) < self.max_pending
        return self.feed_through(item)

    def feed_through(self, item: T) -> bool:
        """As `feed`, past `intercept`."""
        self._stream.append(item)
        if self.on_arrival is not None:
            self.on_arrival(item)
        waiter = self._waiter
        if waiter is not None and not waiter.done():
            waiter.set_result(None)
        return len(self._stream) < self.max_pending

    def feed_lost(self, error: FieldtwinError) -> None:
        """The medium is gone; what arrived before is still read first. The first reason is kept."""
        if self._lost is None:
            self._lost = error
            self._wake()

    def on_room(self) -> None:
        """Called after a consumer took an item; an end that paused its medium resumes here."""

    def _loss(self) -> FieldtwinError:
        """The reason, anew for each `raise`: one that is raised again and again collects tracebacks and `at`s."""
        kept = self._lost or closed_here(self.endpoint)
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
        """As `_next`; `nothing` when nothing came for `timeout_s`."""
        if not self._stream:
            waiter, end = alarm(asyncio.get_running_loop(), timeout_s)
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
        """From now on `waiter` is told when something arrives or the medium is gone. Raises when it is gone already."""
        if self._lost is not None:
            raise self._loss()
        if self._waiter is not None:
            raise Bug("two readers on one connection", where=str(self.endpoint))
        self._waiter = waiter
        return waiter


class ByteConnection(_End[bytes], ABC):
    """One end of a byte stream (serial line or socket). One reader at a time.

    Chunks given to `feed` are as the medium delivered them: their borders mean nothing to a protocol.
    """

    def __init__(self, inbound: Connection[bytes], endpoint: Endpoint, max_pending: int = 1024) -> None:
        super().__init__(inbound, endpoint, max_pending)

    @property
    def type(self) -> PROTOCOL:
        return self.inbound.type

    def read(self) -> Coroutine[Any, Any, bytes]:
        """The next chunk, never empty. Raises `ConnectionLost` once the peer is gone and all is read."""
        return self._next()

    def read_within(self, timeout_s: float) -> Coroutine[Any, Any, bytes]:
        """The next chunk, empty when nothing came for `timeout_s`. Raises as `read`. Costs less than a timeout around it."""
        return self._next_within(timeout_s, b"")

    def read_pending(self) -> bytes:
        """All that arrived and was not read yet, possibly empty; never waits."""
        if not self._stream:
            return b""
        chunks = []
        while self._stream:
            chunks.append(self._stream.popleft())
        self.on_room()
        return b"".join(chunks)

    @abstractmethod
    async def write(self, data: bytes) -> None:
        """Hand `data` to the medium, waiting while its buffer is full. Raises `ConnectionLost`."""

    @abstractmethod
    async def aclose(self) -> None:
        """Close; afterwards `read` raises. Closing twice does nothing."""


class Client(ByteConnection):
    """One that came to us. `peer` is its address, `role` what its certificate names (MBTLS 8.4), empty without one."""

    peer: str
    peer_port: int
    role: str


class Clients(Protocol):
    """A listener and who it let in, oldest first, with what became of the others."""

    accepted: int
    evicted: int
    refused: int
    unshaken: int
    retired: int

    @property
    def bound(self) -> Endpoint:
        """The endpoint with the port that is really listened on."""
        ...

    @property
    def clients(self) -> tuple[Client, ...]: ...

    async def aclose(self) -> None:
        """Stop listening and close every client."""
        ...


Listen = Callable[
    [Endpoint, Callable[[Client], Awaitable[None]], int, Callable[[str], bool], float], Awaitable[Clients]
]
"""``listen(endpoint, on_client, max_clients, admits, idle_s)``. Raises `EndpointBusy` or `Unreachable`."""


class CanConnection(_End[CanFrame], ABC):
    """One node's end of a CAN bus. One reader at a time. A node does not receive its own frames."""

    def __init__(self, inbound: CANConnection, endpoint: Endpoint, max_pending: int = 4096) -> None:
        super().__init__(inbound, endpoint, max_pending)
        self.overruns = 0
        """Frames dropped here because the reader was too slow. A bus waits for nobody."""
        self.accept: Callable[[CanFrame], bool] | None = None
        """The reader's acceptance filter, where it has one: what it refuses never comes in, and was no overrun."""

    def feed(self, item: CanFrame) -> bool:
        if self.accept is not None and not self.accept(item):
            return True
        if len(self.inbound.data_stream) >= self.max_pending:
            self.overruns += 1
            self.on_overrun(item)
            return False
        return super().feed(item)

    def on_overrun(self, item: CanFrame) -> None:
        """Called with a frame that was dropped because the reader was too slow."""

    def recv(self) -> Coroutine[Any, Any, CanFrame]:
        """The next frame. Raises `ConnectionLost` once the bus is gone and all is read."""
        return self._next()

    @abstractmethod
    async def send(self, frame: CanFrame) -> None:
        """Queue `frame` for transmission, waiting while the transmit queue is full. Raises `ConnectionLost`."""

    @abstractmethod
    async def aclose(self) -> None:
        """Leave the bus. Closing twice does nothing."""


class Connector(Protocol):
    """Endpoint -> Connection. The only thing that opens a wire.

    Raises `Unreachable` (or `EndpointBusy`) when there is nobody, `UsageError` when the endpoint is of a kind that
    this connector does not know.
    """

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        """Open a serial port or a socket."""
        ...

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        """Join a CAN bus that runs at `bitrate` bit/s; where the medium knows its bit rate, another one is refused."""
        ...


class Direction(Enum):
    """Seen from the gateway."""

    SENT = "sent"
    RECEIVED = "received"


class Tap(Protocol):
    """An observer on a Connector (recorder, capture). It may not change, delay or drop anything.

    `t_ns` is monotonic. `endpoint` is the plant's endpoint, whatever it is mapped to.
    """

    def on_bytes(self, endpoint: Endpoint, direction: Direction, t_ns: int, data: bytes) -> None: ...

    def on_frame(self, endpoint: Endpoint, direction: Direction, t_ns: int, frame: CanFrame) -> None: ...


def closed_here(endpoint: Endpoint) -> ConnectionLost:
    """The reason that `read` gives after one's own `aclose`."""
    return ConnectionLost("the connection was closed on this side", where=str(endpoint))
