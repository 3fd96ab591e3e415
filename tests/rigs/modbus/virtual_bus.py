"""A gateway's Modbus bus in virtual time: emulated units on a line of 19200 baud, each with its own latency."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import NamedTuple

from modbus_virtual import VirtualLoop, VirtualWire

from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.connection import ByteConnection, CanConnection, RS232Connection, TCPConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.gateway.devices.register_device import RegisterDriver
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.tags import TagTable

LINE = Endpoint.parse("rtu:/dev/ttyVIRT?baudrate=19200&frame=8E1")
CHAR_S = LINE.serial.char_time_s


class Heard(NamedTuple):
    """A request on the line: the time of its first character, its unit, and its PDU."""

    t_s: float
    unit: int
    pdu: bytes


class VirtualLine:
    """A Connector to one line, or to one TCP server for all units, according to the endpoint.

    `units` may change while it runs; a unit answers `latency_s` after its request.
    """

    def __init__(self, loop: VirtualLoop, units: dict[int, ModbusUnit], latency_s: float = 0.005) -> None:
        self.units = units
        self.latency_s = latency_s
        self.slow: dict[int, float] = {}
        """Latencies of slower units, in seconds."""
        self.no_answer: dict[int, float] = {}
        """On TCP: units for which the server, a gateway, replies with exception 0B after so many seconds."""
        self.silent: Callable[[bytes], bool] = lambda frame: False
        """Requests that are not answered."""
        self.heard: list[Heard] = []
        self.opened_s = 0.0
        self._loop = loop
        self._wire: VirtualWire | None = None

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        self.opened_s = self._loop.time()
        kind = RS232Connection if endpoint.is_serial else TCPConnection
        self._wire = VirtualWire(endpoint, self._on_write, kind)
        return self._wire

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        raise Unreachable("no CAN here", where=str(endpoint))

    def _on_write(self, data: bytes) -> None:
        assert self._wire is not None
        if not self._wire.endpoint.is_serial:
            self._on_adu(data)
            return
        self.heard.append(Heard(self._loop.time(), data[0], data[1:-2]))
        if self.silent(data):
            return
        thinks_s = self.slow.get(data[0], self.latency_s)
        for reply in RtuServer(self.units).feed(data, self._loop.monotonic_ns()):
            self._loop.call_later((len(data) + len(reply)) * CHAR_S + thinks_s, self._deliver, reply)

    def _on_adu(self, adu: bytes) -> None:
        unit = adu[6]
        self.heard.append(Heard(self._loop.time(), unit, adu[7:]))
        if self.silent(adu):
            return
        if unit in self.no_answer:
            refusal = adu[:4] + bytes([0, 3, unit, adu[7] | 0x80, 0x0B])
            self._loop.call_later(self.no_answer[unit], self._deliver, refusal)
        elif unit in self.units:
            for reply in MbapServer(self.units).feed(adu, self._loop.monotonic_ns()):
                self._loop.call_later(self.slow.get(unit, self.latency_s), self._deliver, reply)

    def _deliver(self, reply: bytes) -> None:
        assert self._wire is not None
        self._wire.feed(reply)

    def times(self, unit: int, since_s: float = 0.0, address: int | None = None) -> list[float]:
        """Return the times of requests for `unit`, restricted to those for a register `address` if it is given."""
        return [
            h.t_s
            for h in self.heard
            if h.unit == unit and h.t_s >= since_s and address in (None, int.from_bytes(h.pdu[1:3]))
        ]


class VirtualBus(NamedTuple):
    """A bus that runs over a `VirtualLine`."""

    bus: ModbusBus
    line: VirtualLine
    tags: TagTable


async def run_bus(
    make: Callable[[TagTable], list[RegisterDriver]],
    units: dict[int, ModbusUnit],
    scenario: Callable[[VirtualBus], Awaitable[None]],
    *,
    config: BusConfig | None = None,
    latency_s: float = 0.005,
) -> VirtualBus:
    """Run a bus while `scenario`, a coroutine function, runs; both on the running `VirtualLoop`."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    line, tags = VirtualLine(loop, units, latency_s), TagTable(loop)
    drivers = make(tags)
    for driver in drivers:
        tags.declare(driver.tag_names, driver.config.stale_after_ms)
    bus = ModbusBus(config or BusConfig("line", LINE, 0.2, 1), drivers, line, loop, tags, lambda d: None)
    running = VirtualBus(bus, line, tags)
    task = loop.create_task(bus.run())
    try:
        await scenario(running)
    finally:
        task.cancel()
        await asyncio.wait([task])
    assert task.cancelled(), task.exception()
    return running
