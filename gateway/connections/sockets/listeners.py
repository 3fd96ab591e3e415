"""The gateway's listening side: a TCP port, optionally with TLS, whose clients become `ByteConnection`s.

This module must not depend on a protocol. The code that opens the listener decides by address which clients may connect,
interprets the bytes that they send, and decides what the role in a client's certificate permits.
"""

from __future__ import annotations

import asyncio
import errno
import socket
import ssl
from collections.abc import Awaitable, Callable

from fieldtwin.gateway.connections.sockets.tcp import TcpConnection
from fieldtwin.gateway.connections.sockets.tls_listen import HANDSHAKE_LIMIT_S, server_context
from fieldtwin.gateway.connections.sockets.tls_role import role_in
from fieldtwin.gateway.core.connection import Client
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, EndpointBusy, Unreachable, UsageError, os_reason

MAX_CLIENTS = 32
BACKLOG = 64
CLIENT_CHUNKS = 16
"""The number of unread chunks kept per client (64 KiB). Then its socket is not read, and TCP flow control stops the client."""

ACCEPT_PAUSE_S = 0.1
"""The time to wait when the system has no free descriptor for another client."""


class ClientConnection(TcpConnection, Client):
    """The connection of one client.

    `peer` is the client's address, and `last_used_s` the event loop's time in seconds when it last sent data. `role` is the role
    that its certificate names (MBTLS 8.4), or empty.
    """

    def __init__(self, endpoint: Endpoint, peer: str, port: int) -> None:
        super().__init__(endpoint, CLIENT_CHUNKS)
        self.peer = peer
        self.peer_port = port
        self.role = ""
        self._loop = asyncio.get_running_loop()
        self.last_used_s = self._loop.time()
        self.on_arrival = self._used
        self._end_of_stream: ConnectionLost | None = None
        self._secured = False

    def _used(self, data: bytes) -> None:
        self.last_used_s = self._loop.time()

    async def take(self, sock: socket.socket, tls: ssl.SSLContext | None) -> None:
        """Take over an accepted socket, with a TLS handshake if a context is given."""
        self._secured = tls is not None
        limit_s = HANDSHAKE_LIMIT_S if tls is not None else None
        await self._loop.connect_accepted_socket(lambda: self._wire, sock, ssl=tls, ssl_handshake_timeout=limit_s)
        if tls is not None:
            shaken = self._wire.transport.get_extra_info("ssl_object")
            assert isinstance(shaken, ssl.SSLObject)
            self.role = role_in(shaken.getpeercert(binary_form=True) or b"")
        if self._lost is not None:  # the listener evicted this client during the handshake
            self._wire.transport.abort()

    def on_end_of_stream(self, error: ConnectionLost) -> bool:
        """Keep a connection without TLS half-open, so that data that arrived before can be read and answered.

        TLS has no half-closed connections.
        """
        if self._secured:
            return super().on_end_of_stream(error)
        self._end_of_stream = error
        self._wake()
        return True

    def _waits(self, waiter: asyncio.Future[None]) -> asyncio.Future[None]:
        if self._end_of_stream is not None and self._lost is None:
            raise ConnectionLost(self._end_of_stream.message, where=self._end_of_stream.where)
        return super()._waits(waiter)

    def evict(self, why: str) -> None:
        """Close the connection immediately and discard unread data; `read` then raises `ConnectionLost` with the text `why`."""
        self.feed_lost(ConnectionLost(why, where=f"{self.endpoint}: {self.peer}"))
        self.inbound.data_stream.clear()
        if hasattr(self._wire, "transport"):
            self._wire.transport.abort()


OnClient = Callable[[Client], Awaitable[None]]


class TcpListener:
    """A listener that runs `on_client(connection)` for each client that `admits` accepts, and then closes its connection.

    If `max_clients` are connected and another client connects, the connection of the client that has been silent for longest is
    closed (TG 4.2.1, test case MB-065). The connection of a client that has been silent for `idle_s` seconds is closed as well;
    0: never. `refused` counts clients that were not admitted, `unshaken` failed TLS handshakes, `retired` clients that were
    silent for too long.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        sock: socket.socket,
        on_client: OnClient,
        max_clients: int,
        admits: Callable[[str], bool],
        tls: ssl.SSLContext | None = None,
        idle_s: float = 0.0,
    ) -> None:
        """Take over a listening socket. Create a listener with `open` instead."""
        self.accepted = self.evicted = self.refused = self.unshaken = self.retired = 0
        self._endpoint = endpoint
        self._sock = sock
        self._on_client = on_client
        self._max_clients = max_clients
        self._admits = admits
        self._tls = tls
        self._idle_s = idle_s
        self._clients: list[ClientConnection] = []
        self._shaking: dict[ClientConnection, asyncio.Task[None]] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._retiring: asyncio.TimerHandle | None = None
        self._accepting = asyncio.get_running_loop().create_task(self._accept(), name=f"clients of {self.bound}")

    @classmethod
    async def open(
        cls,
        endpoint: Endpoint,
        on_client: OnClient,
        max_clients: int = MAX_CLIENTS,
        admits: Callable[[str], bool] = lambda address: True,
        idle_s: float = 0.0,
    ) -> TcpListener:
        """Listen on a ``tcp://`` or ``tls://`` endpoint; port 0 selects a free port (`bound` has its number).

        Raises `EndpointBusy` if the port is in use, `Unreachable` if it cannot be opened for another reason; a hint has the
        remedy. Raises `UsageError` for any other kind of endpoint.
        """
        if endpoint.scheme not in ("tcp", "tls"):
            raise UsageError(
                "cannot listen on this kind of endpoint",
                expected="tcp://HOST:PORT or tls://HOST:PORT",
                got=str(endpoint),
            )
        loop = asyncio.get_running_loop()
        tls = await loop.run_in_executor(None, server_context, endpoint) if endpoint.scheme == "tls" else None
        sock: socket.socket | None = None
        try:
            # Use the first address only: a name with an IPv4 and an IPv6 address would get two different free ports.
            family, kind, proto, _, address = (
                await loop.getaddrinfo(endpoint.host, endpoint.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
            )[0]
            sock = socket.socket(family, kind, proto)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.setblocking(False)
            sock.bind(address)
            sock.listen(BACKLOG)
        except OSError as e:
            if sock is not None:
                sock.close()
            raise _cannot_listen(endpoint, e) from e
        return cls(endpoint, sock, on_client, max_clients, admits, tls, idle_s)

    @property
    def bound(self) -> Endpoint:
        """Return the endpoint with the actual port, which matters if port 0 was requested."""
        if self._sock.fileno() < 0:
            return self._endpoint
        return self._endpoint.with_address(self._endpoint.host, self._sock.getsockname()[1])

    @property
    def clients(self) -> tuple[ClientConnection, ...]:
        """Return the connected clients, oldest first."""
        return tuple(self._clients)

    async def aclose(self) -> None:
        """Stop listening and close every client. Closing twice does nothing."""
        if self._retiring is not None:
            self._retiring.cancel()
        self._accepting.cancel()
        tasks = [self._accepting, *self._tasks]
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        self._sock.close()

    async def _accept(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                sock, address = await loop.sock_accept(self._sock)
            except OSError:  # no free descriptors, or the client left before it was accepted
                await asyncio.sleep(ACCEPT_PAUSE_S)
                continue
            if not self._admits(address[0]):
                self.refused += 1
                sock.close()
                continue
            self.accepted += 1
            self._make_room()
            client = ClientConnection(self.bound, address[0], address[1])
            self._clients.append(client)
            task = loop.create_task(self._serve(client, sock), name=f"client {address[0]}:{address[1]}")
            self._tasks.add(task)
            if self._tls is not None:
                self._shaking[client] = task
            task.add_done_callback(self._ended)
            self._retire()

    def _make_room(self) -> None:
        while len(self._clients) >= self._max_clients:
            idlest = min(self._clients, key=lambda c: c.last_used_s)
            self.evicted += 1
            self._end(idlest, "closed to make room for another client")

    def _end(self, client: ClientConnection, why: str) -> None:
        self._clients.remove(client)
        shaking = self._shaking.pop(client, None)
        if shaking is not None:
            shaking.cancel()  # no connection exists yet that could be closed
        else:
            client.evict(why)

    def _retire(self) -> None:
        """Close the clients that were silent for too long, and schedule the next check."""
        if self._retiring is not None:
            self._retiring.cancel()
            self._retiring = None
        if not self._idle_s:
            return
        loop = asyncio.get_running_loop()
        for client in [c for c in self._clients if loop.time() >= c.last_used_s + self._idle_s]:
            self.retired += 1
            self._end(client, f"silent for {self._idle_s:g} s")
        if self._clients:
            earliest_s = min(c.last_used_s for c in self._clients) + self._idle_s
            self._retiring = loop.call_at(earliest_s, self._retire)

    async def _serve(self, client: ClientConnection, sock: socket.socket) -> None:
        try:
            await client.take(sock, self._tls)
        except BaseException as e:
            sock.close()
            self._forget(client)
            if isinstance(e, OSError):  # the client left while it was accepted, or its TLS handshake failed
                self.unshaken += self._tls is not None
                return
            raise
        self._shaking.pop(client, None)
        try:
            await self._on_client(client)
        except ConnectionLost:
            pass  # the ordinary end of a client
        finally:
            self._forget(client)
            await client.aclose()

    def _forget(self, client: ClientConnection) -> None:
        self._shaking.pop(client, None)
        if client in self._clients:
            self._clients.remove(client)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        error = None if task.cancelled() else task.exception()
        if error is not None:  # a client's failure ends that client only; it is reported
            report = {"message": f"serving a client of {self._endpoint} failed", "exception": error, "task": task}
            task.get_loop().call_exception_handler(report)


def _cannot_listen(endpoint: Endpoint, error: OSError) -> Unreachable:
    where = str(endpoint)
    if error.errno == errno.EADDRINUSE:
        return EndpointBusy("the port is in use", where=where, hint="another instance?")
    if error.errno == errno.EACCES:
        hint = (
            "ports below 1024 are for root: setcap cap_net_bind_service, or sysctl net.ipv4.ip_unprivileged_port_start"
        )
        return Unreachable("no permission to listen on this port", where=where, hint=hint)
    return Unreachable(f"cannot listen: {os_reason(error)}", where=where)
