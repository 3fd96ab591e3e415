"""The rows of the list of Modbus edge cases that concern the client, each on the whole client.

A row of tests/vectors/modbus_client_rows.toml has bytes and times in, bytes and times out, and the resulting state. It runs
whole, byte by byte and with trailing garbage, in virtual time, so times are exact.
"""

from __future__ import annotations

import asyncio
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from modbus_virtual import VirtualLoop, VirtualWire, run_virtually

from fieldtwin.gateway.core import errors
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.requests import data as requests
from fieldtwin.gateway.protocols.modbus.requests import diagnostics, files, identity, refusals, user
from fieldtwin.gateway.protocols.modbus.requests.replies import Reply
from fieldtwin.gateway.protocols.modbus.requests.request import Request

ROWS = tomllib.loads((Path(__file__).parents[3] / "vectors" / "modbus_client_rows.toml").read_text())["row"]
MS = 1_000_000
TOLERANCE_NS = 1_000

ENDPOINTS = {
    "rtu": "rtu:/dev/line?baudrate=19200&frame=8E1",
    "ascii": "ascii:/dev/line?baudrate=19200&frame=7E1",
    "rtu+tcp": "rtu+tcp://device:4001",
    "mbap": "tcp://device:502",
    "udp": "udp://device:502",
}
GARBAGE = {
    "rtu": b"\x55\xff\x11",
    "ascii": b"\x55\xff:11",
    "rtu+tcp": b"\x55\xff\x11",
    "mbap": bytes.fromhex("99 99 00 00 00 09 11"),  # the beginning of an ADU
    "udp": b"\x00\x00",
}


def make_request(spec: list[Any]) -> Request[Any]:
    name, *args = spec
    module = next(m for m in (requests, diagnostics, files, identity, user) if hasattr(m, name))
    request: Request[Any] = getattr(module, name)(*[tuple(a) if isinstance(a, list) else a for a in args])
    return request


def wire_bytes(text: str, framing: str) -> bytes:
    """Hexadecimal; on an ASCII line the characters themselves, with \\r\\n written out."""
    return text.encode("latin-1") if framing == "ascii" else bytes.fromhex(text)


class Play:
    """One row on one client."""

    def __init__(self, row: dict[str, Any], how: str) -> None:
        self.row, self.how = row, how
        self.framing: str = row.get("framing", "rtu")
        endpoint = Endpoint.parse(ENDPOINTS[self.framing])
        self.char_ns = round(endpoint.serial.char_time_s * 1e9) if endpoint.is_serial else 50_000
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        self.loop = loop
        self.wire = VirtualWire(endpoint, self.sent)
        self.ask: dict[str, Any] = {}
        self.writes = 0
        self.client = ModbusClient.at(
            endpoint, self.wire, loop, timeout_s=row.get("timeout_ms", 100) / 1000, **row.get("settings", {})
        )

    async def all(self) -> None:
        for ask in self.row["ask"]:
            await self.one(ask)
        if self.how != "garbage":
            for name, value in self.row.get("state", {}).items():
                assert self.state(name) == value, name
        c = self.client.counters
        ended = c.broadcasts + c.replies + c.exceptions + c.timeouts + c.crc_errors + c.desyncs
        assert c.requests == ended + c.verify_failures + c.abandoned
        await self.client.aclose()

    def state(self, name: str) -> object:
        return self.client.closed if name == "closed" else getattr(self.client.counters, name)

    async def one(self, ask: dict[str, Any]) -> None:
        self.ask, self.writes = ask, 0
        outcome = await self.outcome(ask)
        assert self.writes == bool(ask["sent"]), "one attempt, or none where nothing may be sent"
        self.judge(ask, outcome)

    def sent(self, data: bytes) -> None:
        self.writes += 1
        assert data == wire_bytes(self.ask["sent"], self.framing)
        now_ns = self.loop.monotonic_ns()
        self.timed(now_ns, self.ask.get("sent_ms"), "sent")
        self.schedule(now_ns, self.ask)

    async def outcome(self, ask: dict[str, Any]) -> Reply | errors.FieldtwinError:
        try:
            reply: Reply = await self.client.execute(ask.get("unit", 0x11), make_request(ask["request"]))
        except errors.FieldtwinError as e:
            self.timed(self.loop.monotonic_ns(), ask.get("done_ms"), "done")
            return e
        self.timed(self.loop.monotonic_ns(), ask.get("done_ms"), "done")
        return reply

    def timed(self, at_ns: int, wanted_ms: float | None, what: str) -> None:
        if wanted_ms is not None and self.how != "garbage":
            assert abs(at_ns - wanted_ms * MS) <= TOLERANCE_NS, f"{what} at {at_ns / MS} ms"

    def schedule(self, sent_ns: int, ask: dict[str, Any]) -> None:
        """Deliver the bytes of the row; the time is that of the last byte, counted from the sending of the request."""
        arrivals = [(at_ms, wire_bytes(text, self.framing)) for at_ms, text in ask.get("arrives", [])]
        if self.how == "garbage" and arrivals and ask.get("tail", True):
            at_ms, data = arrivals[-1]
            if self.framing == "udp":
                arrivals.append((at_ms, GARBAGE["udp"]))
            else:
                arrivals[-1] = (at_ms, data + GARBAGE[self.framing])
        for at_ms, data in arrivals:
            for at_ns, chunk in self.pieces(sent_ns + round(at_ms * MS), data):
                self.loop.call_at(at_ns / 1e9, self.wire.feed, chunk)
        if "lost_ms" in ask:
            reason = errors.ConnectionLost("reset by the far side", where=str(self.wire.endpoint))
            self.loop.call_at((sent_ns + ask["lost_ms"] * MS) / 1e9, self.wire.feed_lost, reason)

    def pieces(self, at_ns: int, data: bytes) -> Iterable[tuple[int, bytes]]:
        if self.how != "bytewise" or self.framing == "udp":
            return [(at_ns, data)]
        first_ns = at_ns - (len(data) - 1) * self.char_ns
        assert first_ns >= self.loop.monotonic_ns(), "the row leaves no time for its bytes"
        return [(first_ns + i * self.char_ns, data[i : i + 1]) for i in range(len(data))]

    def judge(self, ask: dict[str, Any], outcome: Reply | errors.FieldtwinError) -> None:
        if "error" in ask:
            kind = getattr(errors, ask["error"], None) or getattr(refusals, ask["error"])
            assert type(outcome) is kind, repr(outcome)
            if "code" in ask:
                assert isinstance(outcome, errors.ModbusExceptionReply)
                assert outcome.code == ask["code"]
            if "says" in ask:
                assert ask["says"] in str(outcome)
            return
        assert isinstance(outcome, Reply), repr(outcome)
        for name in ("registers", "bits", "acknowledged", "records", "event_count", "value"):
            if name in ask:
                wanted = tuple(ask[name]) if isinstance(ask[name], list) else ask[name]
                assert getattr(outcome, name) == wanted
                return
        assert outcome.raw == bytes.fromhex(ask["raw"])


@pytest.mark.parametrize("how", ["whole", "bytewise", "garbage"])
@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row['case']} {row['title']}")
def test_row_of_the_edge_cases_of_a_client(row: dict[str, Any], how: str) -> None:
    async def main() -> None:
        await Play(row, how).all()

    if how == "bytewise" and not row.get("bytewise", True):
        pytest.skip("the row is about what arrives in one piece")
    run_virtually(main())
