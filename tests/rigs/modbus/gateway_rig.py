"""A gateway's drivers and buses against emulated units, in one process: real frames through memory, no mocks."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from fieldtwin.emulators.endpoints.modbus_server import serve_mbap, serve_rtu
from fieldtwin.emulators.modbus.bank import MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import (
    ByteConnection,
    CanConnection,
    Direction,
    RS232Connection,
    TCPConnection,
)
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, Unreachable
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import resolve
from fieldtwin.gateway.core.files.yaml_file import parse
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.gateway.devices.register_device import RegisterDriver
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock

LINE = Endpoint.parse("rtu:/dev/ttyMEM?baudrate=115200&frame=8E1")
LAN = Endpoint.parse("tcp://mem:502")
PROFILES = Path(__file__).resolve().parents[3] / "profiles" / "devices"


class MemoryEnd(ByteConnection):
    """One end of a wire in memory: written data arrives whole at the other end."""

    peer: MemoryEnd

    async def write(self, data: bytes) -> None:
        if self._lost is not None:
            raise self._loss()
        self.peer.feed(bytes(data))

    async def aclose(self) -> None:
        self.unplug()

    def unplug(self) -> None:
        for end in (self, self.peer):
            end.feed_lost(ConnectionLost("unplugged", where=str(self.endpoint)))


def wire(endpoint: Endpoint) -> tuple[MemoryEnd, MemoryEnd]:
    """Both ends of a new wire of the endpoint's kind."""
    kind = RS232Connection if endpoint.is_serial else TCPConnection
    near, far = MemoryEnd(kind(), endpoint), MemoryEnd(kind(), endpoint)
    near.peer, far.peer = far, near
    return near, far


class FieldBus:
    """A Connector with emulated units behind its one endpoint. `plugged` False: no unit is connected.

    `heard` holds every request ADU in order, `tries` the times of attempts to open it (loop time in s).
    """

    def __init__(self, units: dict[int, ModbusUnit], latency_s: float = 0.0) -> None:
        self.units = units
        self.plugged = True
        self.heard: list[bytes] = []
        self.tries: list[float] = []
        self._latency_s = latency_s
        self._nursery = Nursery()
        self._far: MemoryEnd | None = None

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        self.tries.append(asyncio.get_running_loop().time())
        if not self.plugged:
            raise Unreachable("nobody is there", where=str(endpoint))
        near, self._far = wire(endpoint)
        self._nursery.start(self._serve(self._far, endpoint), f"units {len(self.tries)}")
        return near

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        raise Unreachable("no CAN here", where=str(endpoint))

    async def _serve(self, far: MemoryEnd, endpoint: Endpoint) -> None:
        if endpoint.is_serial:
            await serve_rtu(far, RtuServer(self.units), WallClock(), self._latency_s, self._on_frame)
        else:
            await serve_mbap(far, MbapServer(self.units), WallClock(), self._latency_s, self._on_frame)

    def _on_frame(self, direction: Direction, t_ns: int, adu: bytes) -> None:
        if direction is Direction.SENT:
            self.heard.append(adu)

    def unplug(self) -> None:
        """Pull the cable; no unit is connected until `plugged` is set again."""
        self.plugged = False
        if self._far is not None:
            self._far.unplug()

    async def aclose(self) -> None:
        self.unplug()
        await self._nursery.__aexit__(None, None, None)


class RunningBus:
    """A `ModbusBus` that runs over a `FieldBus`."""

    def __init__(self, bus: ModbusBus, tags: TagTable, field: FieldBus, lost: list[RegisterDriver]) -> None:
        self.bus, self.tags, self.field, self.lost = bus, tags, field, lost

    def quality(self, tag: str) -> tuple[str, str]:
        now = self.tags.current(tag, WallClock().monotonic_ns())
        return str(now.quality), str(now.reason)


@asynccontextmanager
async def running_bus(
    make: Callable[[TagTable], list[RegisterDriver]],
    field: FieldBus,
    endpoint: Endpoint = LINE,
    *,
    timeout_s: float = 0.1,
    retries: int = 1,
) -> AsyncIterator[RunningBus]:
    """`make` builds the drivers on a tag table; every readable tag is declared."""
    clock = WallClock()
    tags = TagTable(clock)
    drivers = make(tags)
    for driver in drivers:
        tags.declare(driver.tag_names, driver.config.stale_after_ms)
    lost: list[RegisterDriver] = []
    bus = ModbusBus(BusConfig("bus", endpoint, timeout_s, retries), drivers, field, clock, tags, lost.append)
    try:
        async with Nursery() as nursery:
            nursery.start(bus.run(), "bus")
            yield RunningBus(bus, tags, field, lost)
    finally:
        await field.aclose()


def profile(text: str) -> DeviceProfile:
    """A Modbus profile; `text` follows the head."""
    head = 'device: test/device\nsource: "a test"\nprotocol: modbus\n'
    return resolve(parse(head + text, "test.yaml"))


def unit(bank: MapBank) -> ModbusUnit:
    return ModbusUnit(bank)
