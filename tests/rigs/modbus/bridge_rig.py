"""A bridge with clients on real sockets, and emulated units on a line in memory."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from support import eventually

from fieldtwin.emulators.endpoints.modbus_server import serve_rtu
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.connections.sockets.tcp import TcpConnection
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.requests.refusals import GatewayRefusal
from fieldtwin.gateway.protocols.modbus.server.analysis import READ_FUNCTIONS, WRITE_FUNCTIONS
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.bridge.bridge import Bridge, BridgeConfig
from fieldtwin.gateway.runtime.bridge.policy import AllowRule, Policy
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock

CLOCK = WallClock()
LINE = Endpoint.parse("rtu:/dev/ttyTEST?baudrate=115200&frame=8N1")
ANY_PORT = Endpoint.parse("tcp://127.0.0.1:0")
WRITERS = Policy((AllowRule(functions=READ_FUNCTIONS | WRITE_FUNCTIONS),), allow_writes=True)


def a_unit(first: int) -> ModbusUnit:
    bank = MapBank([CellSpan("holding", 0, 64), CellSpan("coil", 0, 16)])
    bank.poke("holding", 0, *(first + i for i in range(64)))
    return ModbusUnit(bank, server_id=b"unit %d" % first)


class Rig:
    """A bridge, its line, and the recorded traffic of the line."""

    def __init__(self, bridge: Bridge, bus: ModbusBus, units: dict[int, ModbusUnit], audit: Path, end: PtyEnd) -> None:
        self.bridge, self.bus, self.units = bridge, bus, units
        self._end = end
        self.heard: list[bytes] = []
        self._audit = audit

    async def unplug(self) -> None:
        """Take the line away, and send requests until the bus has noticed."""
        await self._end.aclose()
        async with asyncio.timeout(20), self.client() as client:
            while self.bus.down is None:
                await refused(client, 2)

    @property
    def audit(self) -> list[dict[str, Any]]:
        return [json.loads(text) for text in self._audit.read_text(encoding="ascii").splitlines()]

    @property
    def port(self) -> int:
        assert self.bridge.front.bound is not None
        return self.bridge.front.bound.port

    @asynccontextmanager
    async def client(self, timeout_s: float = 3.0) -> AsyncIterator[ModbusClient]:
        connection = await TcpConnection.open(Endpoint.parse(f"tcp://127.0.0.1:{self.port}"))
        client = ModbusClient(connection, CLOCK, framing="mbap", timeout_s=timeout_s)
        try:
            yield client
        finally:
            await client.aclose()

    @asynccontextmanager
    async def raw(self) -> AsyncIterator[TcpConnection]:
        connection = await TcpConnection.open(Endpoint.parse(f"tcp://127.0.0.1:{self.port}"))
        try:
            yield connection
        finally:
            await connection.aclose()


@asynccontextmanager
async def rig(
    tmp_path: Path,
    config: BridgeConfig | None = None,
    *,
    latency_s: float = 0.0,
    timeout_s: float = 0.15,
    blocked: Callable[[str, int], str] = lambda bus, unit: "",
) -> AsyncIterator[Rig]:
    """Units 1 and 2 on a line, and a bridge that routes every unit there unless `config` says otherwise."""
    units = {1: a_unit(100), 2: a_unit(200)}
    plant = LINE.with_path(str(tmp_path / "line"))
    end = await PtyEnd.open(tmp_path / "line", plant, None)
    audit = AuditLog(tmp_path / "audit.jsonl", CLOCK)
    bus = ModbusBus(BusConfig("line", plant, timeout_s, 1), [], OsConnector(), CLOCK, TagTable(CLOCK), lambda d: None)
    config = config or BridgeConfig("b", ANY_PORT, to="line")
    bridge = Bridge(config, {"line": bus}, OsConnector(), CLOCK, audit, blocked)
    made = Rig(bridge, bus, units, tmp_path / "audit.jsonl", end)

    def note(direction: Direction, t_ns: int, adu: bytes) -> None:
        if direction is Direction.SENT:
            made.heard.append(adu)

    try:
        async with Nursery() as nursery:
            nursery.start(serve_rtu(end, RtuServer(units), CLOCK, latency_s, note), "units")
            nursery.start(bus.run(), "bus")
            nursery.start(bridge.run(), "bridge")
            await eventually(lambda: bridge.front.bound is not None and bus.connected)
            yield made
    finally:
        await end.aclose()
        audit.close()


async def take(connection: TcpConnection, count: int) -> bytes:
    data = b""
    async with asyncio.timeout(5):
        while len(data) < count:
            data += await connection.read()
    return data


async def refused(client: ModbusClient, unit: int, address: int = 0, count: int = 1) -> int:
    with pytest.raises(GatewayRefusal) as caught:
        await client.read_registers(unit, "holding", address, count)
    return caught.value.code


def read_adu(transaction: int, unit: int, address: int, count: int) -> bytes:
    pdu = bytes([3]) + address.to_bytes(2) + count.to_bytes(2)
    return transaction.to_bytes(2) + b"\0\0" + (len(pdu) + 1).to_bytes(2) + bytes([unit]) + pdu
