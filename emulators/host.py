"""The host of emulated devices: serves Modbus units and CANopen nodes on connections, and injects the faults of each bus.

The field simulator of a system and `fieldtwin emulate DEVICE` use it. This module must never depend on profiles, recordings or
system files.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.client_counts import ClientCounts, CountDifference
from fieldtwin.emulators.endpoints.faulty.can import FaultyCan
from fieldtwin.emulators.endpoints.faulty.streams import FaultyEnd
from fieldtwin.emulators.endpoints.faulty.udp import FaultyDatagrams
from fieldtwin.emulators.endpoints.modbus_server import Latency, as_recorded, serve_mbap, serve_rtu, serve_udp
from fieldtwin.emulators.endpoints.ports import CanPort, Listening, Ports
from fieldtwin.emulators.faults.engine import WireFaults
from fieldtwin.emulators.faults.frames import Framing, framing_of
from fieldtwin.emulators.modbus.ascii import AsciiServer
from fieldtwin.emulators.modbus.line import LineServer
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.emulators.replay.unit import ReplayUnit
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import ByteConnection, CanConnection
from fieldtwin.gateway.core.endpoint import SERIAL_SCHEMES, Endpoint
from fieldtwin.gateway.core.errors import UsageError

MAX_CLIENTS = 32
"""The largest number of clients of one Modbus TCP endpoint at a time. A serial line over a socket has one client."""


@dataclass(frozen=True, slots=True)
class ModbusWire:
    """The connection on which Modbus units (servers with a unit ID) are served.

    `listen` is the endpoint to open: ``pty:PATH``, or one of TCP, UDP or TLS. `plant` is the endpoint of the bus in the system
    file; it states the framing and the serial settings. With `pace`, bytes on a pty take as long as on the plant's line; with
    `echo`, clients on a line also receive their own bytes. `latency_s` is the processing time before each reply in seconds; if it
    is 0, units that replay a recording take the recorded time. With `any_unit`, a single unit on TCP answers every unit ID.
    """

    name: str
    listen: Endpoint
    plant: Endpoint
    pace: bool = True
    echo: bool = False
    latency_s: float = 0.0
    any_unit: bool = False

    @property
    def is_line(self) -> bool:
        """Return whether the frames are those of a serial line (RTU or ASCII), whatever kind of connection carries them."""
        return framing_of(self.plant) is not Framing.MBAP


class EmulatorHost:
    """The host of emulated devices: it opens connections and serves the devices on them until `aclose`.

    The connections are made by `ports`. Serving begins with each call of a `serve` method; `run` waits, and raises the failure of
    a server.
    """

    def __init__(self, clock: Clock, ports: Ports) -> None:
        self._clock = clock
        self._ports = ports
        self._nursery = Nursery()
        self._listeners: list[Listening] = []
        self._connections: list[ByteConnection | CanConnection] = []
        self._can_ports: dict[str, CanPort] = {}
        self._clients: dict[str, ClientCounts] = {}
        self._lines: list[CountDifference] = []

    # -- serving --------------------------------------------------------------------------------------------------------

    async def serve_units(
        self, wire: ModbusWire, units: Mapping[int, ModbusUnit], faults: WireFaults | None = None
    ) -> Endpoint:
        """Serve `units`, by unit ID, and return the endpoint that was opened, with its real port.

        Raises `EndpointBusy` or `Unreachable`.
        """
        if wire.listen.scheme == "pty":
            pace = wire.plant.serial if wire.pace else None
            end, bound = await self._ports.serial(Path(wire.listen.path), wire.plant, pace)
            self.serve_line(wire, units, end, faults)
            return bound
        if wire.listen.scheme == "udp":
            return await self._serve_datagrams(wire, units, faults)
        serve, most = (
            (self._line_server(wire, units), 1) if wire.is_line else (self._mbap_server(wire, units), MAX_CLIENTS)
        )

        async def client(connection: ByteConnection) -> None:
            peer = getattr(connection, "peer", "?")
            if faults is None:
                await serve(connection, peer)
                return
            if faults.refuses(self._clock.monotonic_ns()):
                return
            end = FaultyEnd(connection, faults)
            try:
                await serve(end, peer)
            finally:
                await end.aclose()

        listener = await self._ports.listen(wire.listen, client, most)
        self._listeners.append(listener)
        return listener.bound

    def serve_line(
        self, wire: ModbusWire, units: Mapping[int, ModbusUnit], end: ByteConnection, faults: WireFaults | None = None
    ) -> None:
        """Serve `units` on `end`, an open serial line. The host closes it."""
        end = end if faults is None else FaultyEnd(end, faults)
        self._connections.append(end)
        server, latency = line_of(wire.plant, units), _latency(wire, units)
        self._nursery.start(serve_rtu(end, server, self._clock, latency, echo=wire.echo), f"emulators on {wire.name}")

    async def serve_nodes(
        self, name: str, port: CanPort, nodes: Mapping[str, CanopenNode], faults: WireFaults | None = None
    ) -> None:
        """Serve CANopen nodes, by the names of their devices, on a CAN bus. The host closes `port`."""
        self._listeners.append(port)
        self._can_ports[name] = port
        ends: list[CanConnection] = []
        for device, node in nodes.items():
            end = await port.join(device)
            ends.append(end if faults is None else FaultyCan(end, faults, node.node_id))
        self._connections.extend(ends)
        for end, (device, node) in zip(ends, nodes.items(), strict=True):
            self._nursery.start(serve_node(end, node, self._clock), f"node {device}")

    async def _serve_datagrams(
        self, wire: ModbusWire, units: Mapping[int, ModbusUnit], faults: WireFaults | None
    ) -> Endpoint:
        socket = await self._ports.datagrams(wire.listen)
        datagrams = socket if faults is None else FaultyDatagrams(socket, faults)
        self._listeners.append(datagrams)
        server, latency = MbapServer(units, any_unit=wire.any_unit), _latency(wire, units)
        serving = serve_udp(datagrams, server, self._clock, latency, clients=self._counts(wire.name))
        self._nursery.start(serving, f"emulators on {wire.name}")
        return datagrams.bound

    def _line_server(
        self, wire: ModbusWire, units: Mapping[int, ModbusUnit]
    ) -> Callable[[ByteConnection, str], Awaitable[None]]:
        server, latency = line_of(wire.plant, units), _latency(wire, units)
        counted = CountDifference(self._counts(wire.name), lambda: _traffic(units))
        self._lines.append(counted)

        async def serve(end: ByteConnection, client: str) -> None:
            counted.change(client)
            try:
                await serve_rtu(end, server, self._clock, latency, echo=wire.echo)
            finally:
                counted.change("")

        return serve

    def _mbap_server(
        self, wire: ModbusWire, units: Mapping[int, ModbusUnit]
    ) -> Callable[[ByteConnection, str], Awaitable[None]]:
        clients, latency = self._counts(wire.name), _latency(wire, units)

        async def serve(end: ByteConnection, client: str) -> None:
            counts = clients.of(client)
            counts.open = True
            try:
                await serve_mbap(end, MbapServer(units, counts=counts, any_unit=wire.any_unit), self._clock, latency)
            finally:
                counts.open = False

        return serve

    # -- what others see ------------------------------------------------------------------------------------------------

    def clients(self) -> dict[str, dict[str, dict[str, int]]]:
        """Return the numbers of requests that reached a device and of their replies: by name of the connection, then by client.

        Kernel CAN buses and ptys are not included.
        """
        for line in self._lines:
            line.settle()
        found = {name: counts.describe() for name, counts in self._clients.items()}
        for name, port in self._can_ports.items():
            found[name] = port.stats().get("sdo_clients", {})
        return found

    def can_stats(self) -> dict[str, dict[str, Any]]:
        """Return the counters of each CAN bus that is served here, by endpoint."""
        return {str(port.bound): stats for port in self._can_ports.values() if (stats := port.stats())}

    async def join(self, bus: str, name: str) -> CanConnection:
        """Join an emulated CAN bus as a passive listener called `name`. The caller closes the connection."""
        if bus not in self._can_ports:
            raise UsageError(f"no emulated CAN bus {bus!r}", expected=", ".join(self._can_ports) or "one")
        return await self._can_ports[bus].join(name)

    # -- running --------------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Serve until cancelled. Raises the failure of a server."""
        # Socket servers have no task in this nursery, so this task keeps it running.
        self._nursery.start(asyncio.Event().wait(), "until cancelled")
        try:
            await self._nursery.wait()
        finally:
            await self.aclose()

    async def aclose(self) -> None:
        """Stop every server, then close every connection. Raises the failure of a server."""
        try:
            await self._nursery.__aexit__(None, None, None)
        finally:
            for listener in self._listeners:
                await listener.aclose()
            for connection in self._connections:
                await connection.aclose()
            self._listeners.clear()
            self._can_ports.clear()
            self._connections.clear()

    def _counts(self, name: str) -> ClientCounts:
        return self._clients.setdefault(name, ClientCounts())


def line_of(plant: Endpoint, units: Mapping[int, ModbusUnit]) -> LineServer:
    """Return the server for the units of a serial line, in the framing (RTU or ASCII) of the plant's endpoint."""
    return AsciiServer(units) if plant.scheme == "ascii" else RtuServer(units)


def _latency(wire: ModbusWire, units: Mapping[int, ModbusUnit]) -> float | Latency:
    if wire.latency_s or not any(isinstance(unit, ReplayUnit) for unit in units.values()):
        return wire.latency_s
    on_line = wire.pace and wire.listen.scheme in ("pty", *SERIAL_SCHEMES)
    return as_recorded(wire.plant.serial if on_line else None)


def _traffic(units: Mapping[int, ModbusUnit]) -> tuple[int, int]:
    """Return the numbers of requests and replies of all units of a line so far."""
    counters = [unit.counters for unit in units.values()]
    return sum(c.requests for c in counters), sum(c.replies for c in counters)
