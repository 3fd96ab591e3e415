"""The listening side of UDP: it receives datagrams with their senders, and sends datagrams back.

It does not interpret the datagrams. There are no clients, only senders; datagrams that cannot be queued are dropped and counted,
as in a network.
"""

from __future__ import annotations

import asyncio
import errno
import socket
from collections import deque
from typing import cast

from fieldtwin.gateway.core.connection import closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Bug, ConnectionLost, EndpointBusy, Unreachable, os_reason

MAX_PENDING = 256
"""The number of datagrams that may wait for their reader."""

Peer = tuple[str, int]


class UdpEnd(asyncio.DatagramProtocol):
    """A bound UDP socket. Created by `open`; one reader at a time."""

    def __init__(self, endpoint: Endpoint, max_pending: int) -> None:
        self.endpoint = endpoint
        self.dropped = 0
        """Datagrams that came while `max_pending` were waiting, and replies that the network did not accept."""
        self._max_pending = max_pending
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.DatagramTransport | None = None
        self._pending: deque[tuple[bytes, Peer]] = deque()
        self._waiter: asyncio.Future[None] | None = None
        self._lost: ConnectionLost | None = None
        self._full = False
        self._closed = self._loop.create_future()

    @classmethod
    async def open(cls, endpoint: Endpoint, max_pending: int = MAX_PENDING) -> UdpEnd:
        """Bind the socket; port 0 selects a free port (`bound` gives it). Raises `EndpointBusy` or `Unreachable`."""
        end = cls(endpoint, max_pending)
        try:
            infos = await end._loop.getaddrinfo(endpoint.host, endpoint.port, type=socket.SOCK_DGRAM)
            host = str(infos[0][4][0])
            await end._loop.create_datagram_endpoint(lambda: end, local_addr=(host, endpoint.port))
        except OSError as e:
            if e.errno == errno.EADDRINUSE:
                raise EndpointBusy("the port is in use", where=str(endpoint), hint="another instance?") from e
            raise Unreachable(f"cannot listen: {os_reason(e)}", where=str(endpoint)) from e
        return end

    @property
    def bound(self) -> Endpoint:
        """Return the endpoint with the port on which the socket really listens."""
        if self._transport is None:
            return self.endpoint
        return self.endpoint.with_address(self.endpoint.host, self._transport.get_extra_info("sockname")[1])

    async def receive(self) -> tuple[bytes, Peer]:
        """Return the next datagram and its sender. Raises `ConnectionLost` once this end is closed."""
        while not self._pending:
            if self._lost is not None:
                raise ConnectionLost(self._lost.message, where=self._lost.where)
            if self._waiter is not None:
                raise Bug("two readers on one socket", where=str(self.endpoint))
            self._waiter = self._loop.create_future()
            try:
                await self._waiter
            finally:
                self._waiter = None
        return self._pending.popleft()

    async def send(self, data: bytes, peer: Peer) -> None:
        """Send `data` to `peer`, without a delivery report. Raises `ConnectionLost` once this end is closed."""
        if self._lost is not None or self._transport is None:
            raise self._lost or closed_locally(self.endpoint)
        if self._full:  # 64 KiB already wait (asyncio's limit)
            self.dropped += 1
            return
        self._transport.sendto(data, peer)

    async def aclose(self) -> None:
        """Close the socket. Closing twice does nothing."""
        self._end(closed_locally(self.endpoint))
        if self._transport is not None:
            self._transport.abort()
            await asyncio.shield(self._closed)

    def _end(self, reason: ConnectionLost) -> None:
        self._lost = self._lost or reason
        self._pending.clear()
        self._wake()

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)

    # -- called by asyncio ----------------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        # asyncio's transport class does not declare that it is a datagram transport
        self._transport = cast(asyncio.DatagramTransport, transport)

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        if len(self._pending) >= self._max_pending:
            self.dropped += 1
            return
        self._pending.append((data, addr))
        self._wake()

    def pause_writing(self) -> None:
        self._full = True

    def resume_writing(self) -> None:
        self._full = False

    def error_received(self, exc: Exception) -> None:
        self.dropped += 1  # the port to which the reply went is closed, which does not concern this end

    def connection_lost(self, exc: Exception | None) -> None:
        reason = getattr(exc, "strerror", None) or "closed"
        self._end(ConnectionLost(f"the socket is gone: {reason}", where=str(self.endpoint)))
        if not self._closed.done():
            self._closed.set_result(None)
