"""The listening side of TCP and TLS: each client becomes a `ByteConnection`, served by a separate coroutine.

It does not interpret the bytes. The numbers of clients, of chunks per client and of outgoing bytes are limited.
"""

from __future__ import annotations

import asyncio
import errno
import socket
import struct
from collections.abc import Awaitable, Callable
from typing import Any, cast

from fieldtwin.emulators.endpoints.tls_server import client_role, make_context
from fieldtwin.gateway.core.connection import ByteConnection, TCPConnection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, EndpointBusy, Unreachable, os_reason

MAX_CLIENTS = 32
MAX_PENDING_CHUNKS = 16
READ_BYTES = 8192
"""The largest chunk in bytes. It is enough for any pipelining, and limits the effect of a flood. asyncio itself allocates 256
KiB for each read, which takes longer than all other parts of an answer.
"""
CLOSE_WITHIN_S = 1.0
HANDSHAKE_WITHIN_S = 10.0
"""The time limit of a TLS handshake in seconds. A peer that needs longer is disconnected and never counts as a client."""
KEEPALIVE_IDLE_S, KEEPALIVE_INTERVAL_S, KEEPALIVE_PROBES = 10, 5, 3

OnClient = Callable[["SocketEnd"], Awaitable[None]]
Answer = Callable[[bytes], tuple[bytes, bool]]


class SocketEnd(ByteConnection, asyncio.BufferedProtocol):
    """One accepted client. A client that only stopped sending (half-close) still gets its answers."""

    def __init__(self, listener: SocketListener, endpoint: Endpoint) -> None:
        super().__init__(TCPConnection(), endpoint, MAX_PENDING_CHUNKS)
        self.peer = self.host = ""
        self.role = ""
        """The role in the client's certificate (MODBUS/TCP Security, 8.4); empty without TLS, certificate or role."""
        self.last_used_s = 0.0
        """The time of the event loop (s) at which the last byte was transferred in either direction."""
        self._listener = listener
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport | None = None
        self._room: asyncio.Future[None] | None = None
        self._full = False
        self._secured = False
        self._read_into = bytearray(READ_BYTES)
        self._closed = self._loop.create_future()
        self._answer: Answer | None = None

    async def answer_at_once(self, answer: Answer) -> None:
        """Answer every chunk within the callback that delivers it, until the connection is lost, so that a request wakes no task.

        `answer` returns the bytes to send, possibly none, and whether to close the connection after them. While the
        client does not read its answers, nothing more is read from it. Always ends by raising `ConnectionLost`.
        """
        self._answer = answer
        if pending := self.read_pending():
            self._give(pending)
        await self.read()  # no data reach this read any more, so it ends only when the connection is lost

    def _give(self, data: bytes) -> None:
        assert self._answer is not None
        assert self._transport is not None
        out, hang_up = self._answer(data)
        if out:
            self._transport.write(out)
        if hang_up:
            self._transport.close()
        elif self._full:
            self._transport.pause_reading()

    async def write(self, data: bytes) -> None:
        self._raise_if_gone()
        assert self._transport is not None
        self.last_used_s = self._loop.time()
        self._transport.write(data)
        while self._full:
            if self._room is None:
                self._room = self._loop.create_future()
            await asyncio.shield(self._room)
            self._raise_if_gone()

    async def aclose(self) -> None:
        """Send buffered bytes and close, within a second; bytes that the client has not taken by then are dropped."""
        self.feed_lost(closed_locally(self.endpoint))
        if self._transport is None or self._closed.done():
            return
        self._transport.close()
        try:
            async with asyncio.timeout(CLOSE_WITHIN_S):
                await asyncio.shield(self._closed)
        except TimeoutError:
            self._transport.abort()
            await asyncio.shield(self._closed)

    def evict(self, *, reset: bool = False) -> None:
        """Close immediately and drop buffered bytes. With `reset`, close by RST, as a crashed device does."""
        if self._transport is not None:
            if reset:
                sock = self._transport.get_extra_info("socket")
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self._transport.abort()

    def on_room(self) -> None:
        if self._transport is not None and len(self.inbound.data_stream) < self.max_pending:
            self._transport.resume_reading()

    def _raise_if_gone(self) -> None:
        if self._transport is None or self._transport.is_closing():
            raise self.lost or closed_locally(self.endpoint)

    # -- called by asyncio ----------------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)  # uvloop's class is not a subclass of it
        self.last_used_s = self._loop.time()
        name = self._transport.get_extra_info("peername")
        self.peer = f"{name[0]}:{name[1]}" if name else "?"
        self.host = name[0] if name else ""
        inside = transport.get_extra_info("ssl_object")
        self._secured = inside is not None
        if inside is not None:
            self.role = client_role(inside.getpeercert(binary_form=True))
        _keep_alive(transport.get_extra_info("socket"))
        self._listener.connected(self)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._read_into

    def buffer_updated(self, nbytes: int) -> None:
        data = bytes(self._read_into[:nbytes])
        self.last_used_s = self._loop.time()
        if self._answer is not None:
            self._give(data)
        elif not self.feed(data) and self._transport is not None:
            self._transport.pause_reading()

    def eof_received(self) -> bool:
        self.feed_lost(ConnectionLost("the client ended the connection", where=f"{self.endpoint}: {self.peer}"))
        return not self._secured  # TLS has no half-closed connections

    def pause_writing(self) -> None:
        self._full = True

    def resume_writing(self) -> None:
        self._full = False
        if self._answer is not None and self._transport is not None:
            self._transport.resume_reading()
        if self._room is not None:
            self._room.set_result(None)
            self._room = None

    def connection_lost(self, error: Exception | None) -> None:
        reason = getattr(error, "strerror", None) or "closed"
        self.feed_lost(ConnectionLost(f"the client is gone: {reason}", where=f"{self.endpoint}: {self.peer}"))
        self.resume_writing()
        if not self._closed.done():
            self._closed.set_result(None)


class SocketListener:
    """A listener that runs `on_client(connection)` for each client, and then closes the client.

    When `max_clients` are connected, a new client replaces the client that was silent for longest. Clients on `priority` hosts
    (addresses) are replaced only by each other. If no client may be replaced, the new client is refused (TG 4.2.1.1).
    """

    def __init__(
        self, endpoint: Endpoint, on_client: OnClient, max_clients: int, priority: frozenset[str] = frozenset()
    ) -> None:
        self.accepted = 0
        self.evicted = 0
        self.refused = 0
        self.max_clients = max_clients
        self.priority = priority
        self._endpoint = endpoint
        self._on_client = on_client
        self._server: asyncio.Server | None = None
        self._clients: list[SocketEnd] = []
        self._tasks: set[asyncio.Task[None]] = set()

    @classmethod
    async def open(
        cls,
        endpoint: Endpoint,
        on_client: OnClient,
        max_clients: int = MAX_CLIENTS,
        priority: frozenset[str] = frozenset(),
    ) -> SocketListener:
        """Start to listen; port 0 selects a free port (`bound` gives it). Raises `EndpointBusy`, `Unreachable` or `UsageError`.

        A ``tls`` endpoint names the server's certificate with ``cert``, ``key``, and with ``ca`` the authority of
        accepted clients.
        """
        listener = cls(endpoint, on_client, max_clients, priority)
        loop = asyncio.get_running_loop()
        secured: dict[str, Any] = {}
        if endpoint.scheme == "tls":
            secured = {"ssl": make_context(endpoint), "ssl_handshake_timeout": HANDSHAKE_WITHIN_S}
        try:
            # the first address only: a name with an IPv4 and an IPv6 address would get two different free ports
            infos = await loop.getaddrinfo(endpoint.host, endpoint.port, type=socket.SOCK_STREAM)
            host = str(infos[0][4][0])
            listener._server = await loop.create_server(
                lambda: SocketEnd(listener, endpoint), host, endpoint.port, **secured
            )
        except OSError as e:
            if e.errno == errno.EADDRINUSE:
                raise EndpointBusy("the port is in use", where=str(endpoint), hint="another instance?") from e
            raise Unreachable(f"cannot listen: {os_reason(e)}", where=str(endpoint)) from e
        return listener

    @property
    def bound(self) -> Endpoint:
        """Return the endpoint with the port on which the listener really listens."""
        if self._server is None or not self._server.sockets:
            return self._endpoint
        return self._endpoint.with_address(self._endpoint.host, self._server.sockets[0].getsockname()[1])

    @property
    def clients(self) -> tuple[SocketEnd, ...]:
        """Return the connected clients, oldest first."""
        return tuple(self._clients)

    def connected(self, client: SocketEnd) -> None:
        """Handle an accepted client."""
        self.accepted += 1
        if len(self._clients) >= self.max_clients and not self._make_room(client):
            self.refused += 1
            client.evict()
            return
        self._clients.append(client)
        task = asyncio.get_running_loop().create_task(self._serve(client))
        self._tasks.add(task)
        task.add_done_callback(self._ended)

    def _make_room(self, client: SocketEnd) -> bool:
        """Close the client that was silent for longest, among those that the new client may replace."""
        yielding = [c for c in self._clients if c.host not in self.priority]
        if not yielding and client.host in self.priority:
            yielding = self._clients
        if not yielding:
            return False
        idlest = min(yielding, key=lambda c: c.last_used_s)
        self.evicted += 1
        self._clients.remove(idlest)
        idlest.evict()
        return True

    async def aclose(self) -> None:
        """Stop listening, end every client's coroutine, close every client."""
        if self._server is None:
            return
        server, self._server = self._server, None
        server.close()
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)
        await server.wait_closed()

    async def _serve(self, client: SocketEnd) -> None:
        try:
            await self._on_client(client)
        except ConnectionLost:
            pass  # the ordinary end of a client
        finally:
            if client in self._clients:
                self._clients.remove(client)
            await client.aclose()

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        error = None if task.cancelled() else task.exception()
        if error is not None:  # a failure ends only that client; it is reported, not swallowed
            report = {"message": f"serving a client of {self.bound} failed", "exception": error, "task": task}
            task.get_loop().call_exception_handler(report)


def _keep_alive(sock: socket.socket) -> None:
    """Make the system detect within 25 s, instead of two hours, that a client vanished without closing its connection (test
    case MB-064).
    """
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if hasattr(socket, "TCP_KEEPIDLE"):
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, KEEPALIVE_IDLE_S)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, KEEPALIVE_INTERVAL_S)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, KEEPALIVE_PROBES)
