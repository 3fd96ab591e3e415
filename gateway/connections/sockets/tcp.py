"""A TCP connection as a `ByteConnection`.

This module must not depend on a protocol: it does not look for the start of an ADU, and TCP segment boundaries have no meaning
for it.
"""

from __future__ import annotations

import asyncio
import socket
import ssl
from typing import Self, cast

from fieldtwin.gateway.connections.sockets.addresses import address_of
from fieldtwin.gateway.core.connection import ByteConnection, TCPConnection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, Unreachable

CHUNK = 4096
"""The largest number of bytes taken in one read; with `max_pending` it limits the memory of a connection (4 MiB)."""

WRITE_HIGH_WATER = 64 * 1024
"""The number of bytes that may wait for the network before `write` waits too."""

OPEN_TIMEOUT_S = 5.0
CLOSE_LIMIT_S = 0.5

# A peer that lost its power sends nothing. An idle peer is probed after 10 s and given up 15 s later; with data
# outstanding it is given up 20 s after the last acknowledgement (Modbus TCP Implementation Guide 4.2.2).
KEEPALIVE_IDLE_S = 10
KEEPALIVE_INTERVAL_S = 5
KEEPALIVE_PROBES = 3
UNACKNOWLEDGED_MS = 20_000


class TcpConnection(ByteConnection):
    """One end of a TCP stream.

    This object holds at most `max_pending` unread chunks of `CHUNK` bytes. Then the socket is not read until half of them have
    been taken, and TCP flow control stops the sender. When the stream has ended, was reset, or the peer gave no sign of life,
    `read` still returns the bytes that arrived, and then raises `ConnectionLost`.
    """

    def __init__(self, endpoint: Endpoint, max_pending: int = 1024) -> None:
        """Create an object that is not connected. Create a connection with `open` instead."""
        super().__init__(TCPConnection(), endpoint, max_pending)
        self._wire = _Wire(self)

    @classmethod
    async def open(cls, endpoint: Endpoint, timeout_s: float = OPEN_TIMEOUT_S, max_pending: int = 1024) -> Self:
        """Connect to the endpoint's host and port, trying each address of the name.

        Raises `Unreachable` with the cause: the name, the route, a refused connection, or no answer in time.
        """
        connection = cls(endpoint, max_pending)
        await connection._connect(timeout_s)
        return connection

    async def _connect(self, timeout_s: float, tls: ssl.SSLContext | None = None, name: str | None = None) -> None:
        """Connect, with TLS if a context is given; the server's certificate then has to name `name`."""
        where = str(self.endpoint)
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(timeout_s):
                refused: list[OSError] = []
                for address in await resolve(self.endpoint, socket.SOCK_STREAM):
                    try:
                        await loop.create_connection(
                            lambda: self._wire, address, self.endpoint.port, ssl=tls, server_hostname=name
                        )
                        return
                    except OSError as e:
                        refused.append(e)
        except TimeoutError as e:
            raise Unreachable(f"no answer within {timeout_s:g} s", where=where) from e
        if not refused:
            raise Unreachable("the name has no address", where=where)
        # For localhost, the failure of 127.0.0.1 counts: a host without IPv6 gives no useful error for ::1.
        telling = next((e for e in refused if isinstance(e, ConnectionRefusedError)), refused[-1])
        raise self._cannot_open(telling) from telling

    def _cannot_open(self, error: OSError) -> Unreachable:
        where = str(self.endpoint)
        if isinstance(error, ConnectionRefusedError):
            hint = f"the host answers, but no program listens on port {self.endpoint.port}"
            return Unreachable("connection refused", where=where, hint=hint)
        return Unreachable(f"cannot connect: {error.strerror or error}", where=where)

    async def write(self, data: bytes) -> None:
        """Pass `data` to the network, waiting while `WRITE_HIGH_WATER` bytes are unsent. Raises `ConnectionLost`."""
        if self._lost is None and not self._wire.closing:
            self._wire.transport.write(data)
            await self._wire.room.wait()
        if self._lost is not None:
            raise self._loss()
        if self._wire.closing:
            raise _ended(self.endpoint)

    def on_end_of_stream(self, error: ConnectionLost) -> bool:
        """Note that the peer sends no more data. Return True if data may still be sent to it."""
        self.feed_lost(error)
        return False

    async def aclose(self) -> None:
        """Send the data written (waiting at most `CLOSE_LIMIT_S`), then close. Closing twice does nothing."""
        self.feed_lost(closed_locally(self.endpoint))
        self.inbound.data_stream.clear()
        self._wire.transport.close()
        try:
            async with asyncio.timeout(CLOSE_LIMIT_S):
                await self._wire.gone.wait()
        except TimeoutError:
            self._wire.transport.abort()
            await self._wire.gone.wait()

    def on_room(self) -> None:
        if self._wire.paused and len(self.inbound.data_stream) <= self.max_pending // 2:
            self._wire.resume()


class _Wire(asyncio.BufferedProtocol):
    """The protocol object that asyncio calls.

    It is a buffered protocol because a plain one would receive up to 256 KiB per chunk.
    """

    transport: asyncio.Transport

    def __init__(self, connection: TcpConnection) -> None:
        self._connection = connection
        self._buffer = bytearray(CHUNK)
        self.room = asyncio.Event()
        self.room.set()
        self.gone = asyncio.Event()
        self.paused = False

    @property
    def closing(self) -> bool:
        return self.transport.is_closing()

    def resume(self) -> None:
        self.paused = False
        if not self.closing:
            self.transport.resume_reading()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        # uvloop's transport has the same methods, but a different base class
        transport = cast(asyncio.Transport, transport)
        self.transport = transport
        transport.set_write_buffer_limits(high=WRITE_HIGH_WATER)
        _tune(transport.get_extra_info("socket"))
        self._connection.local = address_of(transport)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        if self._connection.lost is None and not self._connection.feed(bytes(self._buffer[:nbytes])):
            self.paused = True
            self.transport.pause_reading()

    def eof_received(self) -> bool:
        return self._connection.on_end_of_stream(_ended(self._connection.endpoint))

    def connection_lost(self, exc: Exception | None) -> None:
        if exc is None:
            error = _ended(self._connection.endpoint)
        else:
            why = getattr(exc, "strerror", None) or str(exc)
            error = ConnectionLost(f"the connection broke: {why}", where=str(self._connection.endpoint))
        self._connection.feed_lost(error)
        self.room.set()
        self.gone.set()

    def pause_writing(self) -> None:
        self.room.clear()

    def resume_writing(self) -> None:
        self.room.set()


def _ended(endpoint: Endpoint) -> ConnectionLost:
    return ConnectionLost("the peer closed the connection", where=str(endpoint))


async def resolve(endpoint: Endpoint, kind: socket.SocketKind) -> list[str]:
    """Return the addresses of the endpoint's host, each once, in the system's order of preference. Raises `Unreachable`."""
    loop = asyncio.get_running_loop()
    try:
        found = await loop.getaddrinfo(endpoint.host, endpoint.port, type=kind)
    except (OSError, UnicodeError) as e:  # UnicodeError: a label that is empty or longer than 63 characters
        why = getattr(e, "strerror", None) or str(e)
        raise Unreachable(f"the name {endpoint.host!r} does not resolve: {why}", where=str(endpoint)) from e
    return list(dict.fromkeys(str(address[0]) for *_, address in found))


def _tune(sock: socket.socket) -> None:
    """Disable Nagle's algorithm, which would delay small requests, and enable keep-alive, which detects a peer that is gone."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (
        ("TCP_KEEPIDLE", KEEPALIVE_IDLE_S),
        ("TCP_KEEPINTVL", KEEPALIVE_INTERVAL_S),
        ("TCP_KEEPCNT", KEEPALIVE_PROBES),
        ("TCP_USER_TIMEOUT", UNACKNOWLEDGED_MS),
    ):
        if hasattr(socket, name):  # some systems do not have all of these options
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
