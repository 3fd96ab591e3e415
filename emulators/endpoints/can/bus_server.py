"""The software CAN bus as a TCP server: each client is a node, each frame a record of 24 bytes.

A client sends a hello (emulators/endpoints/can/bus_hello.py), then both sides send records (gateway/core/canframe.py). If a
client's transmit queue is full, the server stops reading from that client only, so TCP holds it back. A client that
does not read its records loses frames, which are counted, and never stalls the bus. Confirmations are never dropped:
the server stops reading from a client that asked for them and does not read them.

The server does not interpret frames, except SDO requests and replies, which it counts by client, so that a prototype
run can separate its own from those of third-party programs.
"""

from __future__ import annotations

import asyncio
import errno
import socket
from typing import Any, cast

from fieldtwin.emulators.client_counts import ClientCounts, ClientTraffic
from fieldtwin.emulators.endpoints.can.bus_hello import (
    FD_VERSION,
    VERSION,
    WANTS_CONFIRMATIONS,
    WANTS_ERRORS,
    WANTS_VIOLATIONS,
    BusHello,
    Status,
    unpack_hello,
)
from fieldtwin.emulators.endpoints.can.bus_runner import BusRunner
from fieldtwin.emulators.wires.can_faults import ErrorRule
from fieldtwin.gateway.core.can_error import overrun_frame
from fieldtwin.gateway.core.canframe import FD_RECORD_SIZE, RECORD_SIZE, CanFrame, pack_record, unpack_record
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import (
    ConnectionLost,
    Desync,
    EndpointBusy,
    FieldtwinError,
    Unreachable,
    UsageError,
    os_reason,
)

HELLO_TIMEOUT_S = 5.0
SDO_REPLY, SDO_REQUEST = 0x580, 0x600
"""The predefined connection set's function codes (CiA 301, 7.3.3)."""
SDO_ABORT = b"\x80"
CLOSE_TIMEOUT_S = 1.0
SEND_BUFFER_BYTES = 64 * 1024
"""The kernel's send buffer per client, in bytes. By default it grows to megabytes: it would hold minutes of frames, which a slow
client would read late.
"""
RECEIVE_BUFFER_BYTES = 16 * 1024
"""The receive buffer in bytes: TCP stops a sender that does not wait for confirmations after some hundred frames."""


class SoftBusServer:
    """A CAN bus that any process can join. Create it with `open`."""

    def __init__(self, runner: BusRunner, endpoint: Endpoint, max_outbound_frames: int) -> None:
        self._runner = runner
        self._endpoint = endpoint
        self._max_outbound_bytes = max_outbound_frames * RECORD_SIZE
        self._clients: set[_Client] = set()
        self._server: asyncio.Server | None = None
        self.sdo_clients = ClientCounts()
        """SDO requests and replies by client. A reply counts for the client that sent the last request."""
        self._asked_by: dict[int, _Client] = {}
        self.turned_away = 0
        """The number of clients that were refused or violated the protocol."""

    @classmethod
    async def open(
        cls,
        endpoint: Endpoint,
        bitrate: int,
        *,
        paced: bool = True,
        queue_frames: int = 64,
        max_nodes: int = 128,
        max_outbound_frames: int = 4096,
        monitored: bool = True,
        data_bitrate: int = 0,
    ) -> SoftBusServer:
        """Listen on a ``can:fieldtwin/HOST:PORT`` endpoint; port 0 selects a free port (see `bound`).

        `paced`: frames take their exact time at `bitrate` bit/s; otherwise they are delivered immediately.
        `queue_frames` limits each node's transmit queue, `max_outbound_frames` the frames that wait for a slow client.
        `monitored`: the bus itself acknowledges every frame; otherwise a node that is alone on it retries without end,
        as on a real bus. `data_bitrate` in bit/s is that of CAN FD frames with the bit-rate switch, 0 for `bitrate`.

        Raises `EndpointBusy` if the port is in use, `Unreachable` if it cannot be opened, `UsageError` for a different
        kind of endpoint or an impossible bit rate.
        """
        if endpoint.interface != "fieldtwin":
            raise UsageError(f"{endpoint} is not a software CAN bus", expected="can:fieldtwin/HOST:PORT")
        host, port = endpoint.address
        runner = BusRunner(
            bitrate,
            paced=paced,
            queue_frames=queue_frames,
            max_nodes=max_nodes,
            monitored=monitored,
            data_bitrate=data_bitrate,
        )
        bus = cls(runner, endpoint, max_outbound_frames)
        loop = asyncio.get_running_loop()
        try:
            server = await loop.create_server(lambda: _Client(bus, runner), host, port)
        except OSError as e:
            if e.errno == errno.EADDRINUSE:
                raise EndpointBusy("the port of the software CAN bus is in use", where=str(endpoint)) from e
            raise Unreachable(f"cannot listen: {os_reason(e)}", where=str(endpoint)) from e
        for listening in server.sockets:  # accepted sockets inherit this
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        bus._server = server
        bus._endpoint = endpoint.with_address(host, int(server.sockets[0].getsockname()[1]))
        return bus

    @property
    def bound(self) -> Endpoint:
        """Return the endpoint with the port that is really open."""
        return self._endpoint

    @property
    def bitrate(self) -> int:
        return self._runner.bitrate

    @property
    def runner(self) -> BusRunner:
        """Return the bus model, to which other kinds of ports connect, for example an slcan port."""
        return self._runner

    def disturb(self, rule: ErrorRule) -> None:
        """Destroy attempts to send as `rule` says (`fieldtwin.emulators.wires.can_faults.spoil` creates one)."""
        self._runner.disturb(rule)

    def undisturb(self, rule: ErrorRule) -> None:
        """Remove a rule."""
        self._runner.undisturb(rule)

    def attach(self, name: str = "", max_pending: int = 4096) -> CanConnection:
        """Return a connection for a node in this process, without TCP. `max_pending` limits its receive queue."""
        return self._runner.attach(self._endpoint, name, max_pending)

    def bus_stats(self) -> dict[str, Any]:
        """Return JSON-able statistics: see `CanBus.stats` (frames, bits, load, overruns, nodes...), and ``turned_away``."""
        return {**self._runner.stats(), "turned_away": self.turned_away, "sdo_clients": self.sdo_clients.describe()}

    async def aclose(self) -> None:
        """Stop listening and close the bus for all clients. Closing twice does nothing."""
        if self._server is None:
            return
        server, self._server = self._server, None
        server.close()
        self._runner.close(ConnectionLost("the software CAN bus closed", where=str(self._endpoint)))
        gone = [client.gone for client in self._clients]
        for client in list(self._clients):
            client.close()
        if gone:
            await asyncio.wait(gone, timeout=CLOSE_TIMEOUT_S)
            for client in list(self._clients):
                client.abort()  # the client does not read the remaining records
            await asyncio.wait(gone)
        await server.wait_closed()


class _Client(asyncio.Protocol):
    """One TCP client: a `BusPort` after its hello."""

    def __init__(self, bus: SoftBusServer, runner: BusRunner) -> None:
        self._bus = bus
        self._runner = runner
        self._loop = asyncio.get_running_loop()
        self.gone: asyncio.Future[None] = self._loop.create_future()
        self._inbound = bytearray()
        self._outbound = bytearray()
        self._node = 0  # 0 until the hello is accepted
        self._counts = ClientTraffic()
        self._options = 0
        self._fd = False
        self._record_size = RECORD_SIZE
        self._max_outbound_bytes = bus._max_outbound_bytes
        self._lost_since_ns = 0  # start of a loss of frames that has not been reported to this client
        self._reading = True
        self._flooded = False  # the client asked for confirmations and does not read them

    # -- transport ------------------------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport = cast(asyncio.Transport, transport)  # uvloop's class is not a subclass of it
        self._transport = transport
        connection: socket.socket = transport.get_extra_info("socket")
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        transport.set_write_buffer_limits(high=2 * self._bus._max_outbound_bytes, low=self._bus._max_outbound_bytes)
        self._deadline = self._loop.call_later(HELLO_TIMEOUT_S, self._turn_away)
        self._bus._clients.add(self)
        if self._bus._server is None:  # accepted while the bus was closing
            transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._deadline.cancel()
        self._bus._clients.discard(self)
        self._counts.open = False
        for node in [node for node, client in self._bus._asked_by.items() if client is self]:
            del self._bus._asked_by[node]
        if self._node:
            self._runner.leave(self._node)
            self._node = 0
        if not self.gone.done():
            self.gone.set_result(None)

    def data_received(self, data: bytes) -> None:
        self._inbound += data
        self._take()

    @property
    def _confirms(self) -> bool:
        return bool(self._options & WANTS_CONFIRMATIONS)

    def pause_writing(self) -> None:
        self._flooded = self._confirms

    def resume_writing(self) -> None:
        self._flooded = False
        self._take()

    def close(self) -> None:
        self._transport.close()

    def abort(self) -> None:
        self._transport.abort()

    # -- bus ------------------------------------------------------------------------------------------------------

    def on_frame(self, frame: CanFrame) -> bool:
        if frame.fd and not self._fd:
            return True  # a classic node, like a kernel socket without the option for CAN FD
        if frame.can_id & 0x780 == SDO_REPLY and self._bus._asked_by.get(frame.can_id & 0x7F) is self:
            self._counts.replies += 1
        waiting = self._transport.get_write_buffer_size() + len(self._outbound)
        if waiting + 2 * self._record_size > self._max_outbound_bytes:
            self._lost_since_ns = self._lost_since_ns or frame.t_ns or 1
            return False
        if self._lost_since_ns:
            self.on_error(overrun_frame(self._lost_since_ns), violation=False)
            self._lost_since_ns = 0
        self._outbound += pack_record(frame, fd=self._fd)
        return True

    def on_confirmed(self, frame: CanFrame) -> None:
        if self._confirms:
            self._outbound += pack_record(frame, confirmed=True, fd=self._fd)

    def on_error(self, frame: CanFrame, *, violation: bool) -> None:
        waiting = self._transport.get_write_buffer_size() + len(self._outbound)
        if self._options & (WANTS_VIOLATIONS if violation else WANTS_ERRORS) and (
            not violation or waiting + self._record_size <= self._max_outbound_bytes
        ):
            self._outbound += pack_record(frame, fd=self._fd)

    def on_settled(self) -> None:
        if self._outbound:
            self._transport.write(bytes(self._outbound))
            self._outbound.clear()
        if not self._reading:
            self._take()

    def on_bus_closed(self, error: FieldtwinError) -> None:
        self._node = 0

    # -- records --------------------------------------------------------------------------------------------------

    def _take(self) -> None:
        """Process whole records while the bus has room; stop reading when it has none."""
        taken = 0
        blocked = False
        while len(self._inbound) - taken >= (size := self._record_size) and not self._transport.is_closing():
            record = bytes(self._inbound[taken : taken + size])
            if not self._node:
                self._greet(unpack_hello(record))
            elif self._flooded or not self._submit(record):
                blocked = True
                break
            taken += size
        del self._inbound[:taken]
        if self._transport.is_closing():
            self._runner.settle()
            return
        if blocked and self._reading:
            self._transport.pause_reading()
        elif not blocked and not self._reading:
            self._transport.resume_reading()
        self._reading = not blocked
        if taken:
            self._runner.settle()

    def _submit(self, record: bytes) -> bool:
        try:
            frame, confirmed = unpack_record(record)
            if confirmed:
                raise Desync("a confirmation from a node", got=str(frame))
            taken = self._runner.submit(self._node, frame, more=True)
            if taken and frame.can_id & 0x780 == SDO_REQUEST and frame.data[:1] != SDO_ABORT:
                self._counts.requests += 1
                self._bus._asked_by[frame.can_id & 0x7F] = self
            return taken
        # the record is invalid or an error frame, so the rest of the stream cannot be trusted
        except (Desync, UsageError):
            self._turn_away()
            return True

    def _greet(self, hello: BusHello | None) -> None:
        if hello is None:
            self._turn_away()
            return
        status = Status.WELCOME
        data_kbitrate = self._runner.data_bitrate // 1000 if hello.version == FD_VERSION else 0
        if hello.version not in (VERSION, FD_VERSION):
            status = Status.UNKNOWN_VERSION
        elif hello.bitrate not in (0, self._runner.bitrate) or hello.data_kbitrate not in (0, data_kbitrate):
            status = Status.WRONG_BITRATE
        else:
            host, port = self._transport.get_extra_info("peername")[:2]
            try:
                self._node = self._runner.join(self, f"{host}:{port}")
                self._counts = self._bus.sdo_clients.of(f"{host}:{port}")
                self._counts.open = True
            except EndpointBusy:
                status = Status.FULL
            except ConnectionLost:  # the bus is closing, and closes this client too
                self._turn_away()
                return
        self._deadline.cancel()
        self._options = hello.options
        answer = BusHello(
            self._runner.bitrate,
            version=FD_VERSION if hello.version == FD_VERSION else VERSION,
            status=status,
            t_ns=self._runner.now_ns(),
            window=self._runner.queue_frames,
            data_kbitrate=data_kbitrate,
        )
        self._transport.write(answer.pack())
        if hello.version == FD_VERSION:
            self._carry_fd()
        if status is not Status.WELCOME:
            self._bus.turned_away += 1
            self._transport.close()

    def _carry_fd(self) -> None:
        """Use CAN FD records for this client from now on. The limit of waiting frames stays the same."""
        self._fd, self._record_size = True, FD_RECORD_SIZE
        self._max_outbound_bytes = self._max_outbound_bytes * FD_RECORD_SIZE // RECORD_SIZE
        self._transport.set_write_buffer_limits(high=2 * self._max_outbound_bytes, low=self._max_outbound_bytes)

    def _turn_away(self) -> None:
        self._bus.turned_away += 1
        self._transport.abort()
