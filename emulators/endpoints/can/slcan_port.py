"""A TCP port of the software CAN bus that speaks slcan: each client that opens its channel is a node.

It serves programs that support neither the bus's records nor python-can's interface ``fieldtwin``: slcand through socat,
python-can's own ``slcan`` interface with ``socket://HOST:PORT``, terminal programs. `slcan_protocol` implements the protocol.
"""

from __future__ import annotations

import asyncio
import errno
import socket
from typing import cast

from fieldtwin.emulators.endpoints.can.bus_runner import BusRunner
from fieldtwin.emulators.endpoints.can.slcan_protocol import SlcanSession
from fieldtwin.gateway.core.can_error import overrun_frame
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import EndpointBusy, FieldtwinError, Unreachable, os_reason

MAX_OUTBOUND_BYTES = 64 * 1024
"""The number of bytes that may wait for a slow client. Further frames are lost and counted."""
MAX_CLIENTS = 64
SOCKET_BUFFER_BYTES = 16 * 1024


class SlcanPort:
    """The slcan listener of a bus. Create it with `open`; close it with `aclose` before the bus."""

    def __init__(self, runner: BusRunner) -> None:
        self.runner = runner
        self.clients: set[_Client] = set()
        self.turned_away = 0
        self._server: asyncio.Server | None = None
        self._bound = ("", 0)

    @classmethod
    async def open(cls, runner: BusRunner, endpoint: Endpoint) -> SlcanPort:
        """Listen on a ``tcp://HOST:PORT`` endpoint; port 0 selects a free port (see `bound`).

        Raises `EndpointBusy` if the port is in use, `Unreachable` if it cannot be opened.
        """
        port = cls(runner)
        host, number = endpoint.address
        try:
            server = await asyncio.get_running_loop().create_server(lambda: _Client(port), host, number)
        except OSError as e:
            if e.errno == errno.EADDRINUSE:
                raise EndpointBusy("the slcan port is in use", where=str(endpoint)) from e
            raise Unreachable(f"cannot listen: {os_reason(e)}", where=str(endpoint)) from e
        for listening in server.sockets:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BUFFER_BYTES)
        port._server = server
        port._bound = (host, int(server.sockets[0].getsockname()[1]))
        return port

    @property
    def bound(self) -> tuple[str, int]:
        """Return host and port that are really open."""
        return self._bound

    async def aclose(self) -> None:
        """Stop listening and disconnect the clients. Closing twice does nothing."""
        if self._server is None:
            return
        server, self._server = self._server, None
        server.close()
        gone = [client.gone for client in self.clients]
        for client in list(self.clients):
            client.abort()
        if gone:
            await asyncio.wait(gone)
        await server.wait_closed()


class _Client(asyncio.Protocol):
    """One TCP client: a `BusPort` while its channel is open."""

    def __init__(self, port: SlcanPort) -> None:
        self._port = port
        self._session = SlcanSession(port.runner.bitrate)
        self._node = 0
        self._outbound = bytearray()
        self._reading = True
        self.gone: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    # -- transport ------------------------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        connection: socket.socket = transport.get_extra_info("socket")
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SOCKET_BUFFER_BYTES)
        self._name = "slcan {}:{}".format(*transport.get_extra_info("peername")[:2])
        self._port.clients.add(self)
        if len(self._port.clients) > MAX_CLIENTS:
            self._port.turned_away += 1
            self._transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._port.clients.discard(self)
        self._leave()
        if not self.gone.done():
            self.gone.set_result(None)

    def data_received(self, data: bytes) -> None:
        self._session.feed(data)
        self._take()

    def abort(self) -> None:
        self._transport.abort()

    # -- bus ------------------------------------------------------------------------------------------------------

    def on_frame(self, frame: CanFrame) -> bool:
        if frame.fd:
            return True  # the protocol does not support CAN FD
        if self._transport.get_write_buffer_size() + len(self._outbound) > MAX_OUTBOUND_BYTES:
            self._session.controller(overrun_frame())
            return False
        self._outbound += self._session.received(frame)
        return True

    def on_confirmed(self, frame: CanFrame) -> None:
        """Do nothing: this protocol confirms that a frame was queued, not that it was sent."""

    def on_error(self, frame: CanFrame, *, violation: bool) -> None:
        self._session.controller(frame)

    def on_settled(self) -> None:
        if not self._reading:
            self._take()
        self._flush()

    def on_bus_closed(self, error: FieldtwinError) -> None:
        self._node = 0
        self._transport.close()

    # -- commands -------------------------------------------------------------------------------------------------

    def _take(self) -> None:
        """Execute whole commands while the bus has room; stop reading when it has none."""
        while not self._transport.is_closing() and (answer := self._session.step(self._submit)) is not None:
            self._outbound += answer
            self._follow()
        if self._transport.is_closing():
            return
        self._flush()
        waiting = self._session.waiting
        if waiting and self._reading:
            self._transport.pause_reading()
        elif not waiting and not self._reading:
            self._transport.resume_reading()
        self._reading = not waiting

    def _submit(self, frame: CanFrame) -> bool:
        return bool(self._node) and self._port.runner.submit(self._node, frame)

    def _follow(self) -> None:
        """Join or leave the bus if the session has been opened or closed."""
        if self._session.is_open and not self._node:
            try:
                self._node = self._port.runner.join(self, self._name, listen_only=self._session.listen_only)
            except FieldtwinError:  # the bus is full or closing
                self._port.turned_away += 1
                self._transport.abort()
        elif not self._session.is_open:
            self._leave()

    def _leave(self) -> None:
        if self._node:
            self._port.runner.leave(self._node)
            self._node = 0

    def _flush(self) -> None:
        if self._outbound and not self._transport.is_closing():
            self._transport.write(bytes(self._outbound))
        self._outbound.clear()
