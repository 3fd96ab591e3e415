"""The rows of the test-case list that concern the bridge: clients of a bridge, and a scripted line.

A row of tests/vectors/modbus_gateway.toml has bytes and times in, bytes and times out, and the counters of the bridge. It runs
whole (then the times are exact, in virtual time), byte by byte and with trailing garbage.
"""

from __future__ import annotations

import asyncio
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from modbus_virtual import VirtualLoop, VirtualWire, run_virtually

from fieldtwin.gateway.connections.sockets.listeners import ClientConnection
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import ByteConnection, CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, Unreachable
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.gateway.protocols.modbus.server.analysis import READ_FUNCTIONS, WRITE_FUNCTIONS
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.bridge.bridge import Bridge, BridgeConfig, Route
from fieldtwin.gateway.runtime.bridge.policy import AllowRule, Policy
from fieldtwin.gateway.runtime.bridge.tcp import TcpFront
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.tags import TagTable

ROWS = tomllib.loads((Path(__file__).parents[3] / "vectors" / "modbus_gateway.toml").read_text())["row"]
MS = 1_000_000
TOLERANCE_MS = 0.001
LINE = Endpoint.parse("rtu:/dev/line?baudrate=19200&frame=8E1")
LISTEN = Endpoint.parse("tcp://127.0.0.1:502")
LINE_CHAR_NS = round(LINE.serial.char_time_s * 1e9)
SEGMENT_NS = 50_000
LINE_GARBAGE = b"\x55\xff\x70"
CLIENT_GARBAGE = bytes.fromhex("99 99 00 00 00 09 11")  # the beginning of an ADU
POLICY = Policy((AllowRule(functions=READ_FUNCTIONS | WRITE_FUNCTIONS),), allow_writes=True)


class VirtualClient(ClientConnection):
    """A client with a socket in memory; `said` has the replies with their times."""

    def __init__(self, number: int, loop: VirtualLoop) -> None:
        super().__init__(LISTEN, "127.0.0.1", 40000 + number)
        self.said: list[tuple[float, bytes]] = []
        self._clock = loop

    async def write(self, data: bytes) -> None:
        if self.lost is not None:
            raise ConnectionLost("the client is gone", where="127.0.0.1")
        self.said.append((self._clock.monotonic_ns() / MS, bytes(data)))

    async def aclose(self) -> None:
        self.go()

    def go(self) -> None:
        self.feed_lost(ConnectionLost("the client is gone", where="127.0.0.1"))


class Play:
    """One row on one bridge. It is the connector to its own line."""

    def __init__(self, row: dict[str, Any], how: str, audit: AuditLog) -> None:
        self.row, self.how = row, how
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        self.loop = loop
        self.wire = VirtualWire(LINE, self.sent)
        self.sends: list[dict[str, Any]] = list(row.get("line", []))
        settings: dict[str, Any] = {"to": "line", **row.get("settings", {})}
        if "routes" in settings:
            settings |= {"to": None, "routes": {int(u): Route("line", n) for u, n in settings["routes"].items()}}
        self.bus = ModbusBus(
            BusConfig("line", LINE, 0.1, row.get("retries", 1)), [], self, loop, TagTable(loop), lambda d: None
        )
        config = BridgeConfig("b", LISTEN, policy=POLICY, **settings)
        self.bridge = Bridge(config, {"line": self.bus}, self, loop, audit)
        self.clients = [VirtualClient(n, loop) for n in range(1 + max(s.get("client", 0) for s in row["steps"]))]

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        return self.wire

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        raise Unreachable("no CAN here", where=str(endpoint))

    def sent(self, data: bytes) -> None:
        """The bridge sends: this must be the row's next frame, at its time; the units answer as the row defines."""
        now_ns = self.loop.monotonic_ns()
        assert self.sends, f"sent besides: {data.hex(' ')}"
        wanted = self.sends.pop(0)
        assert data == bytes.fromhex(wanted["sent"])
        if "at_ms" in wanted and self.how == "whole":
            assert abs(now_ns / MS - wanted["at_ms"]) < TOLERANCE_MS, f"{data.hex(' ')} sent at {now_ns / MS} ms"
        for at_ms, text in wanted.get("arrives", []):
            frame = bytes.fromhex(text)
            if self.how == "garbage" and wanted.get("tail", True):
                frame += LINE_GARBAGE
            for at_ns, chunk in self.pieces(now_ns + round(at_ms * MS), frame, LINE_CHAR_NS):
                self.loop.call_at(at_ns / 1e9, self.wire.feed, chunk)

    def pieces(self, at_ns: int, data: bytes, byte_ns: int) -> Iterable[tuple[int, bytes]]:
        """The last byte arrives at `at_ns`."""
        if self.how != "bytewise":
            return [(at_ns, data)]
        first_ns = at_ns - (len(data) - 1) * byte_ns
        assert first_ns >= self.loop.monotonic_ns(), "the row leaves no time for its bytes"
        return [(first_ns + i * byte_ns, data[i : i + 1]) for i in range(len(data))]

    async def all(self) -> None:
        front = self.bridge.front
        assert isinstance(front, TcpFront)
        last = {step.get("client", 0): step for step in self.row["steps"] if "hear" in step}
        async with Nursery() as nursery:
            nursery.start(self.bus.run(), "bus")
            sessions = [nursery.start(self.serve(client), "client") for client in self.clients]
            for step in self.row["steps"]:
                number, at_ns = step.get("client", 0), round(step["at_ms"] * MS)
                data = bytes.fromhex(step.get("hear", ""))
                if self.how == "garbage" and data and step == last[number] and step.get("tail", True):
                    data += CLIENT_GARBAGE
                for when_ns, chunk in self.pieces(at_ns, data, SEGMENT_NS) if data else ():
                    self.loop.call_at(when_ns / 1e9, self.clients[number].feed, chunk)
                if step.get("gone"):
                    self.loop.call_at(at_ns / 1e9, self.clients[number].go)
            await self.loop.sleep_until_ns(self.row.get("over_ms", 2000) * MS)
            assert [n for n, session in enumerate(sessions) if session.done()] == self.row.get("closed", [])
        self.judge()

    async def serve(self, client: VirtualClient) -> None:
        assert isinstance(self.bridge.front, TcpFront)
        try:
            await self.bridge.front._serve(client)
        except ConnectionLost:
            pass

    def judge(self) -> None:
        assert not self.sends, f"never sent: {self.sends[0]['sent']}"
        for number, client in enumerate(self.clients):
            wanted = [s for s in self.row.get("say", []) if s.get("client", 0) == number]
            assert [data.hex(" ") for _, data in client.said] == [s["adu"] for s in wanted], f"client {number}"
            for (at_ms, data), say in zip(client.said, wanted, strict=True):
                if "at_ms" in say and self.how == "whole":
                    assert abs(at_ms - say["at_ms"]) < TOLERANCE_MS, f"{data.hex(' ')} said at {at_ms} ms"
        if self.how != "garbage":
            counters = {**self.bus.totals(), **self.bridge.status().counters}
            for name, value in self.row.get("state", {}).items():
                assert counters[name] == value, name


@pytest.mark.parametrize("how", ["whole", "bytewise", "garbage"])
@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row['case']} {row['title']}")
def test_row_of_the_edge_cases_of_a_bridge(row: dict[str, Any], how: str, tmp_path: Path) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        audit = AuditLog(tmp_path / "audit.jsonl", loop)
        try:
            await Play(row, how, audit).all()
        finally:
            audit.close()

    if how == "bytewise" and not row.get("bytewise", True):
        pytest.skip("the row is about what arrives in one piece")
    run_virtually(main())
