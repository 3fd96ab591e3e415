"""100 MB of garbage through every Modbus receiver: it stores a frame or two, and receives a request after the garbage.

This covers garbage that each receiver discards fast enough for a default run; slower kinds, one MB each, are in
test_server_flood.py and in test_modbus_hostile_bytes.py, where the client's framers get their 100 MB.
"""

from __future__ import annotations

import random
import resource
import sys
from collections.abc import Callable

import pytest

from fieldtwin.emulators.modbus.ascii import AsciiServer
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.protocols.modbus.server.line import LOST_AFTER, LineRequest, RtuRequests
from fieldtwin.gateway.protocols.modbus.server.mbap import MbapRequests

CHUNK = 1 << 20
CHUNKS = 100
GROWTH_KB = 16 * 1024
"""Maximum growth of the process: some chunks. 100 MB of stored bytes would be six times that."""
READ_ADU = bytes.fromhex("0001 0000 0006 01 03 0000 0001")
READ_FRAME = bytes.fromhex("01 03 0000 0001 840A")
FOREIGN_ADU = bytes.fromhex("0001 0001 00FE 01") + bytes(253)

GARBAGE = {
    "zeros": bytes(CHUNK),
    "ones": b"\xff" * CHUNK,
    "random": random.Random(70).randbytes(CHUNK),
    "another protocol": FOREIGN_ADU * (CHUNK // len(FOREIGN_ADU)),
}


def units() -> dict[int, ModbusUnit]:
    return {1: ModbusUnit(MapBank([CellSpan("holding", 0, 4)]))}


def flood(feed: Callable[[bytes, int], object], kept: Callable[[], int], kind: str, chunks: int = CHUNKS) -> int:
    """Feed it; return the duration on the line, in ns."""
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    now_ns = NS_PER_S
    for _ in range(chunks):
        feed(GARBAGE[kind], now_ns)
        now_ns += 1_000
        assert kept() <= 600
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < GROWTH_KB
    return now_ns


@pytest.mark.parametrize("kind", ["zeros", "ones"])
def test_an_rtu_server(kind: str) -> None:
    server = RtuServer(units())
    now_ns = flood(server.feed, lambda: server.pending, kind)
    assert server.counters.noise_bytes >= CHUNKS * CHUNK - 600
    server.feed(b"", now_ns + NS_PER_S)
    assert len(server.feed(READ_FRAME, now_ns + 2 * NS_PER_S)) == 1


@pytest.mark.parametrize("kind", ["zeros", "random"])
def test_an_ascii_server(kind: str) -> None:
    server = AsciiServer(units())
    now_ns = flood(server.feed, lambda: server.pending, kind)
    assert len(server.feed(b":010300000001FB\r\n", now_ns + 2 * NS_PER_S)) == 1


@pytest.mark.parametrize("kind", sorted(GARBAGE))
def test_a_tcp_server(kind: str) -> None:
    server = MbapServer(units())
    chunks = 4 if kind == "zeros" else CHUNKS  # ADUs of length 0, one in six bytes, each dropped separately
    flood(server.feed, lambda: server.pending, kind, chunks)
    assert server.requests == 0
    assert (server.desync is None) == (kind in ("zeros", "another protocol"))
    answered = server.feed(READ_ADU, 2 * NS_PER_S)
    assert len(answered) == (1 if kind == "another protocol" else 0) or kind == "zeros"


@pytest.mark.parametrize("kind", sorted(GARBAGE))
def test_the_gateways_own_tcp_server(kind: str) -> None:
    stream = MbapRequests()
    flood(lambda data, now_ns: stream.feed(data), lambda: len(stream._buffer), kind)
    assert bool(stream.desync) == (kind != "another protocol")
    assert len(stream.feed(READ_ADU)) == (kind == "another protocol")


@pytest.mark.parametrize("kind", ["zeros", "ones", "random"])
def test_the_reverse_bridge_clears_a_flood_with_little_work_and_finds_the_request_after_it(kind: str) -> None:
    """Defect: each byte of a flood was tried as the start of a frame of any unit, at 0.9 MB a second."""
    line, calls = RtuRequests(86_000, units=[1]), 0

    def count(frame: object, event: str, argument: object) -> None:
        nonlocal calls
        calls += event == "call"

    data = GARBAGE[kind] * 10
    sys.setprofile(count)
    try:
        for at in range(0, len(data), 1000):
            line.feed(data[at : at + 1000])
    finally:
        sys.setprofile(None)
    assert calls < 2 * LOST_AFTER * 8 + len(data) / 100
    assert line.feed(READ_FRAME)[-1:] == [LineRequest(1, READ_FRAME[1:-2])]


@pytest.mark.parametrize("kind", ["zeros", "ones", "random"])
def test_the_gateways_own_rtu_server(kind: str) -> None:
    """A tenth of a MB: nine seconds of a line of 115200 bit/s."""
    line = RtuRequests(86_000)
    for at in range(0, 100_000, 1000):
        line.feed(GARBAGE[kind][at : at + 1000])
        assert len(line._buffer) <= 256
    line.silence()
    assert line.noise_bytes >= 100_000 - 260 * line.frames
    assert len(line.feed(READ_FRAME)) == 1
