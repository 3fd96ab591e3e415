"""Floods of garbage through the servers' receivers: linear time, bounded memory, and a request after it is answered.

1 MB of each kind; FIELDTWIN_FLOOD_MB=100 for more.
"""

from __future__ import annotations

import contextlib
import os
import random
import resource
import tracemalloc
from collections.abc import Iterator

import pytest

from fieldtwin.emulators.modbus.ascii import AsciiServer
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.line import LineServer
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.endpoint import SerialSettings

MEGABYTES = int(os.environ.get("FIELDTWIN_FLOOD_MB", "1"))
CHUNK = 65536
MEMORY = 1_000_000
"""Bytes: the size of some chunks, whatever the flood's size."""
RTU_READ = bytes.fromhex("01 03 0000 0001 840A")
LINE = SerialSettings()


@contextlib.contextmanager
def bounded_memory() -> Iterator[None]:
    """Measure the memory to the byte for a small flood; for a large one, which would take too long, by the growth of the
    process."""
    if MEGABYTES > 2:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        yield
        assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < 8 * MEMORY
        return
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < MEMORY
    finally:
        tracemalloc.stop()


def make_units() -> dict[int, ModbusUnit]:
    return {1: ModbusUnit(MapBank([CellSpan("holding", 0, 4)]))}


def make_line(kind: str) -> tuple[LineServer, bytes]:
    if kind == "ascii":
        return AsciiServer(make_units()), b":010300000001FB\r\n"
    return RtuServer(make_units(), strict=LINE if kind == "strict" else None), RTU_READ


def garbage(kind: str) -> Iterator[bytes]:
    """The flood in chunks, from a seed."""
    source = random.Random(2706)
    fixed = {"zeros": bytes(CHUNK), "ones": b"\xff" * CHUNK, "colons": b":" * CHUNK, "halves": b":0103" * (CHUNK // 5)}
    for _ in range(MEGABYTES * 1_000_000 // CHUNK + 1):
        yield fixed.get(kind) or source.randbytes(CHUNK)


@pytest.mark.timeout(60 + MEGABYTES)
@pytest.mark.parametrize("flood", ["random", "zeros", "ones", "colons", "halves"])
@pytest.mark.parametrize("kind", ["rtu", "ascii", "strict"])
def test_a_line_server_survives_garbage_in_bounded_memory(kind: str, flood: str) -> None:
    server, request = make_line(kind)
    now_ns, heard = NS_PER_S, 0
    with bounded_memory():
        for chunk in garbage(flood):
            now_ns += len(chunk) * 100_000
            server.feed(chunk, now_ns)
            heard += len(chunk)
            assert kind == "strict" or server.pending < 600
    now_ns += 3 * NS_PER_S
    server.feed(b"", now_ns)
    assert server.counters.noise_bytes >= heard - 600 * server.counters.frames, "what is dropped is counted"
    now_ns += 20_000_000
    replies = server.feed(request, now_ns)
    replies += server.feed(b"", now_ns + 3 * NS_PER_S)
    assert len(replies) == 1


def test_a_line_byte_by_byte() -> None:
    """The receiver tries every byte of a flood, but must not try all of them again with each."""
    server, request = make_line("rtu")
    data = next(garbage("random"))
    for i in range(len(data)):
        server.feed(data[i : i + 1], NS_PER_S + i * 1000)
    assert server.counters.crc_errors <= 1, "one run of noise"
    assert len(server.feed(request, 2 * NS_PER_S)) == 1


def test_a_request_in_the_middle_of_a_flood_is_found() -> None:
    server, request = make_line("rtu")
    data = next(garbage("random"))
    replies = server.feed(data + request + data, NS_PER_S)
    assert len(replies) == 1
    assert server.units[1].counters.requests == 1


@pytest.mark.timeout(60 + MEGABYTES)
@pytest.mark.parametrize("flood", ["random", "zeros", "ones", "protocol 1"])
def test_a_tcp_server_survives_garbage_in_bounded_memory(flood: str) -> None:
    """Zeros are ADUs of length 0, each dropped separately; the others are invalid at once."""
    server = MbapServer(make_units())
    heard = bytes.fromhex("0001 0001 0006 01 03 0000 0001") * (CHUNK // 12)
    with bounded_memory():
        for chunk in garbage(flood):
            server.feed(heard if flood == "protocol 1" else chunk, NS_PER_S)
            assert server.pending < 260
    assert server.requests == 0
    assert (server.desync is None) == (flood in ("zeros", "protocol 1"))
    assert server.discarded > 0
