"""The ends between which an emulated connection forwards bytes: an outgoing or incoming TCP connection, and a serial device.

They share no code with the gateway's ends, so that a mistake in one cannot be hidden by the same mistake in
the other. Virtual serial ports are in fieldtwin.emulators.endpoints.pty. These ends do not interpret the bytes.
"""

from __future__ import annotations

import asyncio
import errno
import os
import socket
from pathlib import Path
from typing import Any

from fieldtwin.gateway.core.connection import ByteConnection, RS232Connection, TCPConnection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import (
    ConnectionLost,
    EndpointBusy,
    FieldtwinError,
    Unreachable,
    UsageError,
    os_reason,
)
from fieldtwin.gateway.core.files.port_marker import refuse_dead_port

try:
    import fcntl
    import termios
except ImportError:  # Windows
    TTYS = False
else:
    TTYS = True

CHUNK = 4096
MAX_PENDING = 64
"""The number of chunks that may wait in an end. With `CHUNK` it limits the bytes in flight in each direction (256 KiB)."""
PTY_MAJORS = range(136, 144)
"""Device numbers of the slave side of Linux pseudo-terminals (Linux, Documentation/admin-guide/devices.txt)."""

WRITE_HIGH_WATER = 64 * 1024
CLOSE_LIMIT_S = 0.5


class TcpEnd(ByteConnection):
    """One end of a TCP connection that carries the bytes of a link.

    A peer that has finished sending may still be receiving (half-closed): then `read` raises, `write` works, and
    `half_closed` is true. `finish` does the same in the other direction.
    """

    def __init__(self, endpoint: Endpoint, door: TcpAcceptor | None = None) -> None:
        """Create an unconnected end, for the listener `door` if given. Use `dial` or `TcpAcceptor.next_peer` instead."""
        super().__init__(TCPConnection(), endpoint, MAX_PENDING)
        self.wire = _Wire(self, door)

    @classmethod
    async def dial(cls, endpoint: Endpoint, timeout_s: float) -> TcpEnd:
        """Connect to `endpoint` and return the end. Raises `Unreachable` with the reason."""
        end = cls(endpoint)
        try:
            async with asyncio.timeout(timeout_s):
                await asyncio.get_running_loop().create_connection(lambda: end.wire, *endpoint.address)
        except TimeoutError as e:
            raise Unreachable(f"no answer within {timeout_s:g} s", where=str(endpoint)) from e
        except (OSError, UnicodeError) as e:
            why = os_reason(e) if isinstance(e, OSError) else str(e)
            raise Unreachable(f"cannot connect: {why}", where=str(endpoint)) from e
        return end

    @property
    def half_closed(self) -> bool:
        return self.wire.eof and not self.wire.gone.is_set()

    async def write(self, data: bytes) -> None:
        if self.wire.open:
            self.wire.transport.write(data)
            await self.wire.room.wait()
        if not self.wire.open:
            raise self._loss()

    def finish(self) -> None:
        """Tell the peer that no more bytes follow, and continue to receive."""
        if self.wire.open:
            self.wire.transport.write_eof()

    async def aclose(self) -> None:
        self.feed_lost(closed_locally(self.endpoint))
        self.inbound.data_stream.clear()
        self.wire.transport.close()
        try:
            async with asyncio.timeout(CLOSE_LIMIT_S):
                await self.wire.gone.wait()
        except TimeoutError:  # the peer does not read the rest
            self.wire.transport.abort()
            await self.wire.gone.wait()

    def on_room(self) -> None:
        if self.wire.paused and len(self.inbound.data_stream) <= self.max_pending // 2:
            self.wire.paused = False
            if self.wire.open:
                self.wire.transport.resume_reading()


class _Wire(asyncio.BufferedProtocol):
    """The asyncio protocol of a `TcpEnd`."""

    transport: asyncio.Transport

    def __init__(self, end: TcpEnd, door: TcpAcceptor | None) -> None:
        self._end = end
        self._acceptor = door
        self._buffer = bytearray(CHUNK)
        self.room = asyncio.Event()
        self.room.set()
        self.gone = asyncio.Event()
        self.paused = False
        self.eof = False

    @property
    def open(self) -> bool:
        return not self.transport.is_closing()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        # asyncio's stream servers and clients create no other kind of transport
        self.transport = transport  # type: ignore[assignment]
        self.transport.set_write_buffer_limits(high=WRITE_HIGH_WATER)
        _tune(transport.get_extra_info("socket"))
        if self._acceptor is not None:
            self._acceptor.connected(self._end)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        if self._end.lost is None and not self._end.feed(bytes(self._buffer[:nbytes])):
            self.paused = True
            self.transport.pause_reading()

    def eof_received(self) -> bool:
        self.eof = True
        self._end.feed_lost(ConnectionLost("the peer finished sending", where=str(self._end.endpoint)))
        return True  # stay open to send the rest

    def connection_lost(self, exc: Exception | None) -> None:
        why = (getattr(exc, "strerror", None) or str(exc)) if exc else "closed"
        self._end.feed_lost(ConnectionLost(f"the carrier is gone: {why}", where=str(self._end.endpoint)))
        self.room.set()
        self.gone.set()

    def pause_writing(self) -> None:
        self.room.clear()

    def resume_writing(self) -> None:
        self.room.set()


class TcpAcceptor:
    """A listener that accepts one peer at a time, because a serial line has one client.

    While a peer is connected, further ones are closed immediately and counted in `refused`. A peer that has half-closed
    or disconnected does not block the next one.
    """

    def __init__(self, endpoint: Endpoint) -> None:
        self.bound = endpoint
        self.refused = 0
        self._server: asyncio.Server | None = None
        self._inside: TcpEnd | None = None
        self._next: TcpEnd | None = None
        self._knock = asyncio.Event()

    @classmethod
    async def open(cls, endpoint: Endpoint) -> TcpAcceptor:
        """Start to listen. Afterwards `bound` contains the actual port. Raises `EndpointBusy` or `Unreachable`."""
        door = cls(endpoint)
        where = str(endpoint)
        try:
            door._server = await asyncio.get_running_loop().create_server(door._admit, *endpoint.address)
        except OSError as e:
            if e.errno == errno.EADDRINUSE:
                raise EndpointBusy("another program listens here", where=where) from e
            raise Unreachable(f"cannot listen: {os_reason(e)}", where=where) from e
        door.bound = endpoint.with_address(endpoint.host, door._server.sockets[0].getsockname()[1])
        return door

    async def next_peer(self) -> TcpEnd:
        """Wait for the next peer."""
        while self._next is None or self._next.wire.gone.is_set():
            self._knock.clear()
            await self._knock.wait()
        self._inside, self._next = self._next, None
        return self._inside

    async def aclose(self) -> None:
        if self._server is not None:
            self._server.close()
            for end in (self._inside, self._next):
                if end is not None:
                    await end.aclose()
            await self._server.wait_closed()
            self._server = None

    def _admit(self) -> _Wire:
        return TcpEnd(self.bound, self).wire

    def connected(self, end: TcpEnd) -> None:
        """Handle a new connection. Its asyncio protocol calls this method."""
        if any(other is not None and other.wire.open and not other.wire.eof for other in (self._inside, self._next)):
            self.refused += 1
            end.wire.transport.abort()
            return
        if self._next is not None:  # the peer finished sending before its connection was served
            self.refused += 1
            self._next.wire.transport.abort()
        self._next = end
        self._knock.set()


def _tune(sock: socket.socket) -> None:
    """Disable Nagle's algorithm, and detect within half a minute that a peer has lost power."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 3), ("TCP_USER_TIMEOUT", 25_000)):
        if hasattr(socket, option):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


class TtyEnd(ByteConnection):
    """A serial device of this computer, opened exclusively in raw mode with the endpoint's baud rate and frame."""

    def __init__(self, fd: int, endpoint: Endpoint) -> None:
        super().__init__(RS232Connection(), endpoint, MAX_PENDING)
        self._fd = fd
        self._loop = asyncio.get_running_loop()
        self._room: asyncio.Future[None] | None = None
        self._paused = False
        self._loop.add_reader(fd, self._on_readable)

    @classmethod
    def open(cls, endpoint: Endpoint) -> TtyEnd:
        """Open and configure the device. Raises `Unreachable`, `EndpointBusy`, or `UsageError` for unsupported settings."""
        where = str(endpoint)
        if not TTYS:
            raise Unreachable("this system has no serial devices as files", where=where, hint="a tcp end works")
        refuse_dead_port(Path(endpoint.path), where)
        try:
            fd = os.open(endpoint.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError as e:
            kind = EndpointBusy if e.errno == errno.EBUSY else Unreachable
            raise kind(f"cannot open the serial device: {e.strerror}", where=where) from e
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            _make_raw(fd, endpoint)
            termios.tcflush(fd, termios.TCIFLUSH)
        except BlockingIOError as e:
            os.close(fd)
            raise EndpointBusy("the serial device is held by another program", where=where) from e
        except (OSError, termios.error) as e:
            os.close(fd)
            raise Unreachable(f"this is not a serial device: {e}", where=where) from e
        except FieldtwinError:
            os.close(fd)
            raise
        return cls(fd, endpoint)

    async def write(self, data: bytes) -> None:
        rest = memoryview(data)
        while rest:
            if self._lost is not None:
                raise self._loss()
            try:
                rest = rest[os.write(self._fd, rest) :]
            except BlockingIOError:
                await self._wait_for_room()
            except OSError as e:
                self._end(ConnectionLost(f"the serial device is gone: {e.strerror}", where=str(self.endpoint)))

    async def aclose(self) -> None:
        self._end(closed_locally(self.endpoint))
        self.inbound.data_stream.clear()

    def on_room(self) -> None:
        if self._paused and self._lost is None and len(self.inbound.data_stream) <= self.max_pending // 2:
            self._paused = False
            self._loop.add_reader(self._fd, self._on_readable)

    def _on_readable(self) -> None:
        try:
            data = os.read(self._fd, CHUNK)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._end(ConnectionLost("the serial device is gone", where=str(self.endpoint)))
        elif not self.feed(data):
            self._paused = True
            self._loop.remove_reader(self._fd)

    async def _wait_for_room(self) -> None:
        self._room = self._loop.create_future()
        self._loop.add_writer(self._fd, self._on_writable)
        try:
            await self._room
        finally:
            self._room = None
            if self._lost is None:
                self._loop.remove_writer(self._fd)

    def _on_writable(self) -> None:
        if self._room is not None and not self._room.done():
            self._room.set_result(None)

    def _end(self, error: ConnectionLost) -> None:
        if self._lost is None:
            self.feed_lost(error)
            self._loop.remove_reader(self._fd)
            self._loop.remove_writer(self._fd)
            os.close(self._fd)
            self._on_writable()


def _make_raw(fd: int, endpoint: Endpoint) -> None:
    settings = endpoint.serial
    speed = getattr(termios, f"B{settings.baudrate}", None)
    if speed is None:
        raise UsageError(f"{endpoint}: baud rate", expected="one of the standard rates", got=str(settings.baudrate))
    attributes: list[Any] = termios.tcgetattr(fd)
    cflag = termios.CREAD | termios.CLOCAL | (termios.CS8 if settings.data_bits == 8 else termios.CS7)
    # A pty drops parity, and glibc's tcsetattr then fails with EINVAL when a port is opened a second time
    # (docs/decisions/0013).
    parity = "N" if os.major(os.fstat(fd).st_rdev) in PTY_MAJORS else settings.parity
    cflag |= {"N": 0, "E": termios.PARENB, "O": termios.PARENB | termios.PARODD}[parity]
    cflag |= termios.CSTOPB if settings.stop_bits == 2 else 0
    attributes[0:4] = [0, 0, cflag, 0]  # no translation, no flow control, no echo, no signals
    attributes[4] = attributes[5] = speed
    attributes[6][termios.VMIN] = 1  # with VMIN 0, a read could not distinguish an empty device from a disconnected one
    attributes[6][termios.VTIME] = 0
    termios.tcsetattr(fd, termios.TCSANOW, attributes)
