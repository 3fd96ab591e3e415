"""A UDP socket as a `ByteConnection`: each chunk is one datagram, and so is each `write`.

UDP has no connection that could be lost. An absent peer shows only in missing replies, or in the network's error (ICMP) that the
port is closed. This module must not depend on a protocol: it interprets neither the content nor the order of datagrams.
"""

from __future__ import annotations

import asyncio
import socket
from typing import cast

from fieldtwin.gateway.connections.sockets.addresses import address_of
from fieldtwin.gateway.connections.sockets.tcp import resolve
from fieldtwin.gateway.core.connection import ByteConnection, TCPConnection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError, Unreachable

WRITE_HIGH_WATER = 64 * 1024
OPEN_TIMEOUT_S = 5.0


class UdpConnection(ByteConnection):
    """One end of an exchange of datagrams (in the paper, a TCP connection, since it has no other network connection).

    Only datagrams of the peer are accepted. This object holds at most `max_pending` unread datagrams; it drops and counts
    further ones. If the boundaries of datagrams matter, do not use `read_pending`, which joins the waiting datagrams.
    """

    def __init__(self, endpoint: Endpoint, max_pending: int = 256) -> None:
        """Create an object without a socket. Create a connection with `open` instead."""
        super().__init__(TCPConnection(), endpoint, max_pending)
        self.dropped = 0
        """Datagrams that arrived while `max_pending` were waiting, and empty ones."""
        self._wire = _Wire(self)

    @classmethod
    async def open(cls, endpoint: Endpoint, timeout_s: float = OPEN_TIMEOUT_S, max_pending: int = 256) -> UdpConnection:
        """Open a socket for the endpoint's host and port. Only a reply shows whether the peer exists.

        Raises `Unreachable` if the name has no address or no route leads to it.
        """
        where = str(endpoint)
        connection = cls(endpoint, max_pending)
        try:
            async with asyncio.timeout(timeout_s):
                addresses = await resolve(endpoint, socket.SOCK_DGRAM)
            await asyncio.get_running_loop().create_datagram_endpoint(
                lambda: connection._wire, remote_addr=(addresses[0], endpoint.port)
            )
        except TimeoutError as e:
            raise Unreachable(f"no answer from the name service within {timeout_s:g} s", where=where) from e
        except OSError as e:
            raise Unreachable(f"cannot send to this address: {e.strerror or e}", where=where) from e
        return connection

    async def write(self, data: bytes) -> None:
        """Send `data` as one datagram, waiting while `WRITE_HIGH_WATER` bytes are unsent. Raises `ConnectionLost`."""
        if self._lost is None:
            self._wire.transport.sendto(data)
            await self._wire.room.wait()
        if self._lost is not None:
            raise self._loss()

    async def aclose(self) -> None:
        """Close the socket. Closing twice does nothing."""
        self.end(closed_locally(self.endpoint))
        self.inbound.data_stream.clear()
        await self._wire.gone.wait()

    def end(self, reason: FieldtwinError) -> None:
        """Close the socket for `reason`. Only the first reason is kept."""
        self.feed_lost(reason)
        self._wire.room.set()
        self._wire.transport.abort()


class _Wire(asyncio.DatagramProtocol):
    """The asyncio protocol object of the socket; it passes datagrams and errors to the `UdpConnection`."""

    transport: asyncio.DatagramTransport

    def __init__(self, connection: UdpConnection) -> None:
        self._connection = connection
        self.room = asyncio.Event()
        self.room.set()
        self.gone = asyncio.Event()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.DatagramTransport, transport)  # on Python 3.11 it is not a subclass
        cast(asyncio.WriteTransport, transport).set_write_buffer_limits(high=WRITE_HIGH_WATER)
        self._connection.local = address_of(transport)

    def datagram_received(self, data: bytes, addr: object) -> None:
        connection = self._connection
        if not data or len(connection.inbound.data_stream) >= connection.max_pending:
            connection.dropped += 1
        elif connection.lost is None:
            connection.feed(data)

    def error_received(self, exc: Exception) -> None:
        endpoint = self._connection.endpoint
        if isinstance(exc, ConnectionRefusedError):
            hint = f"the host answers, but no program listens on UDP port {endpoint.port}"
            self._connection.end(ConnectionLost("no program listens there", where=str(endpoint), hint=hint))
        else:
            self._connection.end(ConnectionLost(f"cannot send: {_why(exc)}", where=str(endpoint)))

    def connection_lost(self, exc: Exception | None) -> None:
        where = str(self._connection.endpoint)
        self._connection.feed_lost(ConnectionLost(f"the socket is gone: {_why(exc)}", where=where))
        self.room.set()
        self.gone.set()

    def pause_writing(self) -> None:
        self.room.clear()

    def resume_writing(self) -> None:
        self.room.set()


def _why(error: Exception | None) -> str:
    return getattr(error, "strerror", None) or str(error or "closed")
