"""Ports in memory on one event loop with virtual time: simulated field devices listen on them, and a gateway connects to them.

Endpoints have the same form as those of real ports, and port 0 is replaced by consecutive numbers, but no port of the operating
system is opened.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from fieldtwin.emulators.endpoints.can.bus_runner import AttachedConnection, BusRunner
from fieldtwin.emulators.endpoints.ports import OnClient
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.emulators.virtual.memory_stream import MemoryEnd, MemoryWire
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import ByteConnection, CanConnection, Client, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.core.errors import Bug, ConnectionLost, EndpointBusy, Unreachable, UsageError

FIRST_PORT = 50_000


class MemoryNet:
    """A network in memory: `fieldtwin.emulators.endpoints.ports.Ports` for the simulated field devices, and a `Connector` for
    the gateway.
    """

    def __init__(self, loop: VirtualLoop) -> None:
        self.loop = loop
        self.wires: list[MemoryWire] = []
        """The open connections, in the order in which they were opened."""
        self._listeners: dict[str, _Listener | MemoryDatagrams] = {}
        self._serial: dict[str, _SerialPort] = {}
        self._buses: dict[str, MemoryBus] = {}
        self._refused: set[str] = set()
        self._next_port = FIRST_PORT

    # -- field devices ------------------------------------------------------------------------------------------------

    async def serial(self, link: Path, plant: Endpoint, pace: SerialSettings | None) -> tuple[ByteConnection, Endpoint]:
        named = Endpoint("pty", path=str(link))
        port = _SerialPort(self, plant.with_path(str(link)), pace)
        self._serial[str(link)] = port
        return port.field, named

    async def listen(self, endpoint: Endpoint, on_client: OnClient, max_clients: int) -> _Listener:
        bound = self._bound(endpoint)
        listener = _Listener(self, bound, on_client, max_clients)
        self._listeners[_key(bound)] = listener
        return listener

    async def datagrams(self, endpoint: Endpoint) -> MemoryDatagrams:
        bound = self._bound(endpoint)
        end = MemoryDatagrams(self, bound)
        self._listeners[_key(bound)] = end
        return end

    async def can_bus(self, endpoint: Endpoint, bitrate: int, *, paced: bool) -> MemoryBus:
        if endpoint.interface == "fieldtwin":
            host, port = endpoint.address
            endpoint = endpoint.with_address(host, port or self._port())
        bus = MemoryBus(self, endpoint, BusRunner(bitrate, paced=paced))
        self._buses[str(endpoint)] = bus
        return bus

    def _bound(self, endpoint: Endpoint) -> Endpoint:
        bound = endpoint.with_address(endpoint.host, endpoint.port or self._port())
        if _key(bound) in self._listeners:
            raise EndpointBusy("the port is in use", where=str(bound))
        return bound

    def _port(self) -> int:
        self._next_port += 1
        return self._next_port - 1

    # -- gateway ------------------------------------------------------------------------------------------------------

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        """Connect to a port as `OsConnector` does. Raises `Unreachable` if the endpoint does not exist or refuses connections."""
        key = _key(endpoint)
        if endpoint.is_serial:
            port = self._serial.get(endpoint.path)
            if port is None or key in self._refused:
                raise Unreachable("no such port", where=str(endpoint))
            return port.plug_in()
        listener = self._listeners.get(key)
        if listener is None or key in self._refused:
            raise Unreachable("connection refused", where=str(endpoint))
        wire = self._wire(endpoint, listener.bound, None, serial=False)
        listener.connected(wire)
        return wire.near

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        bus = self._buses.get(str(endpoint))
        if bus is None or str(endpoint) in self._refused:
            raise Unreachable("no such bus", where=str(endpoint))
        if bitrate and bitrate != bus._runner.bitrate:
            raise UsageError(
                "the bus runs at a different bit rate", expected=str(bus._runner.bitrate), got=str(bitrate)
            )
        return bus._runner.attach(endpoint, "gateway")

    async def listen_for_clients(
        self,
        endpoint: Endpoint,
        on_client: Callable[[Client], Awaitable[None]],
        max_clients: int,
        admits: Callable[[str], bool],
        idle_s: float,
    ) -> _Listener:
        """Listen for the gateway's own clients in memory (`fieldtwin.gateway.core.connection.Listen`).

        Every client is admitted, and may be silent for any length of time.
        """
        bound = self._bound(endpoint)
        listener = _Listener(self, bound, on_client, max_clients)
        self._listeners[_key(bound)] = listener
        return listener

    # -- wires --------------------------------------------------------------------------------------------------------

    def runner(self, listening: Endpoint) -> BusRunner:
        """Return the bus at `listening`."""
        return self._buses[str(listening)]._runner

    def refuse(self, listening: Endpoint, *, refused: bool = True) -> None:
        """Set whether connections to `listening` are refused from now on."""
        (self._refused.add if refused else self._refused.discard)(_key(listening))

    def _wire(
        self, gateway_end: Endpoint, field_end: Endpoint, pace: SerialSettings | None, *, serial: bool
    ) -> MemoryWire:
        self.wires = [wire for wire in self.wires if wire.near.lost is None or wire.far.lost is None]
        wire = MemoryWire(self.loop, gateway_end, field_end, pace, serial=serial)
        self.wires.append(wire)
        return wire


def _key(endpoint: Endpoint) -> str:
    """Return the key by which an endpoint is found: a path, or host and port."""
    if endpoint.is_can:
        return str(endpoint)
    return endpoint.path or f"{endpoint.host}:{endpoint.port}"


class _SerialPort:
    """A serial line whose device end stays the same when the gateway's end is closed and opened again."""

    def __init__(self, net: MemoryNet, plant: Endpoint, pace: SerialSettings | None) -> None:
        self._net = net
        self._pace = pace
        self._plant = plant
        self._wire = net._wire(plant, plant, pace, serial=True)
        self._wire.near.feed_lost(closed_locally(plant))
        self.field: MemoryEnd = self._wire.far

    def plug_in(self) -> MemoryEnd:
        """Return a new end for the gateway.

        Raises `EndpointBusy` while the previous end is open, because only one program can hold a port.
        """
        if self._wire.near.lost is None:
            raise EndpointBusy("another program holds the port", where=str(self._plant))
        self._wire.near = MemoryEnd.again(self._wire.near)
        return self._wire.near


class _Listener:
    """A listener of field devices, or of the gateway (`fieldtwin.gateway.core.connection.Clients`)."""

    def __init__(
        self, net: MemoryNet, bound: Endpoint, on_client: Callable[[Client], Awaitable[None]], max_clients: int
    ) -> None:
        self.bound = bound
        self.max_clients = max_clients
        self.accepted = self.evicted = self.refused = self.unshaken = self.retired = 0
        self._net = net
        self._on_client = on_client
        self._clients: list[MemoryEnd] = []
        self._nursery = Nursery()

    def connected(self, wire: MemoryWire) -> None:
        """Accept a client; if there is no room, close the oldest one."""
        self._clients = [client for client in self._clients if client.lost is None]
        self.accepted += 1
        if len(self._clients) >= self.max_clients:
            self.evicted += 1
            oldest = self._clients.pop(0)
            oldest.wire.cut(ConnectionLost("the connection was replaced by a newer one", where=str(oldest.endpoint)))
        self._clients.append(wire.far)
        self._nursery.start(self._serve(wire.far), f"client of {self.bound}")

    @property
    def clients(self) -> tuple[MemoryEnd, ...]:
        """Return the connected clients, oldest first."""
        return tuple(client for client in self._clients if client.lost is None)

    async def _serve(self, client: MemoryEnd) -> None:
        try:
            await self._on_client(client)
        except ConnectionLost:
            pass  # the ordinary end of a client
        finally:
            await client.aclose()

    async def aclose(self) -> None:
        """Stop serving clients."""
        self._net._listeners.pop(_key(self.bound), None)
        await self._nursery.__aexit__(None, None, None)


class MemoryDatagrams:
    """A UDP socket in memory (`fieldtwin.emulators.endpoints.ports.Datagrams`): each write of a client is one datagram."""

    def __init__(self, net: MemoryNet, bound: Endpoint) -> None:
        self.bound = bound
        self._net = net
        self._pending: deque[tuple[bytes, tuple[str, int]]] = deque(maxlen=256)
        self._peers: dict[tuple[str, int], MemoryWire] = {}
        self._waiter: asyncio.Future[None] | None = None
        self._closed = False

    def connected(self, wire: MemoryWire) -> None:
        peer = ("memory", len(self._peers))
        self._peers[peer] = wire
        wire.far.on_arrival = lambda data: self._arrived(wire, data, peer)

    def _arrived(self, wire: MemoryWire, data: bytes, peer: tuple[str, int]) -> None:
        wire.far.inbound.data_stream.clear()
        self._pending.append((data, peer))
        self._wake()

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)

    async def receive(self) -> tuple[bytes, tuple[str, int]]:
        while not self._pending:
            if self._closed:
                raise closed_locally(self.bound)
            if self._waiter is not None:
                raise Bug("two readers on one socket", where=str(self.bound))
            self._waiter = self._net.loop.create_future()
            try:
                await self._waiter
            finally:
                self._waiter = None
        return self._pending.popleft()

    async def send(self, data: bytes, peer: tuple[str, int]) -> None:
        wire = self._peers.get(peer)
        if wire is not None and wire.far.lost is None:
            await wire.far.write(data)

    async def aclose(self) -> None:
        self._closed = True
        self._net._listeners.pop(_key(self.bound), None)
        self._wake()


class MemoryBus:
    """A CAN bus in memory (`fieldtwin.emulators.endpoints.ports.CanPort`): nodes join the bus model itself, without a socket."""

    def __init__(self, net: MemoryNet, bound: Endpoint, runner: BusRunner) -> None:
        self.bound = bound
        self.runner: BusRunner | None = runner
        self._runner = runner
        self._net = net

    async def join(self, name: str) -> AttachedConnection:
        return self._runner.attach(self.bound, name)

    def stats(self) -> dict[str, Any]:
        return self._runner.stats()

    async def aclose(self) -> None:
        self._net._buses.pop(str(self.bound), None)
        self._runner.close(closed_locally(self.bound))
