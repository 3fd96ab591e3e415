"""The wire vectors of tests/vectors/modbus_server.toml against the pure servers: whole, byte by byte, with trailing garbage."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest

from fieldtwin.emulators.modbus.ascii import AsciiServer
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.functions.fifo import FifoQueues
from fieldtwin.emulators.modbus.functions.identification import Identification
from fieldtwin.emulators.modbus.line import LineServer
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit, UnitLimits
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.endpoint import SerialSettings

VECTORS = tomllib.loads((Path(__file__).parents[2] / "vectors" / "modbus_server.toml").read_text())["vector"]
LINE = SerialSettings(19200, "8E1")
BYTE_NS = 572_917
LONG_PAUSE_NS = 2_000 * NS_PER_MS


def ids(vector: dict[str, Any]) -> str:
    return str(vector["id"])


def make_unit(even_only: bool) -> ModbusUnit:
    """The device of the vectors."""
    bank = MapBank(
        [
            CellSpan("coil", 0, 37),
            CellSpan("coil", 40, 8),
            CellSpan("holding", 0, 200),
            CellSpan("holding", 299, 1),
            CellSpan("holding", 300, 1, access="ro"),
            CellSpan("input", 0, 8),
        ]
    )
    bank.poke("holding", 0, 0xAA, 0xBB)
    bank.poke("holding", 4, 0x12)
    bank.poke("input", 0, 0x4120)
    fifos = FifoQueues([0x04DE, 0x04DF], capacity=40)
    fifos.push(0x04DE, 0x01B8, 0x1284)
    fifos.push(0x04DF, *range(32))
    names = {0: b"fieldtwin", 1: b"FT-1", 2: b"V2.11", 3: b"u" * 200, 4: b"n" * 60}
    return ModbusUnit(bank, UnitLimits(even_only=even_only), fifos=fifos, identification=Identification(names))


class Rig:
    """Units on one wire, and the bytes on it."""

    def __init__(self, vector: dict[str, Any]) -> None:
        self.vector = vector
        self.wire = vector.get("wire", "rtu")
        self.units = {n: make_unit(vector.get("even_only", False)) for n in vector.get("units", [1])}
        self.server: LineServer | MbapServer
        if self.wire in ("mbap", "udp"):
            self.server = MbapServer(self.units, vector.get("max_in_flight", 16))
        elif self.wire == "ascii":
            self.server = AsciiServer(self.units)
        else:
            self.server = RtuServer(self.units, strict=LINE if self.wire == "rtu-strict" else None)

    def bytes_of(self, text: str) -> bytes:
        return text.encode() if self.wire == "ascii" else bytes.fromhex(text)

    def feed(self, data: bytes, now_ns: int, piece: int) -> list[bytes]:
        """Feed `data`, whose last byte arrives at `now_ns`, in pieces of `piece` bytes."""
        if self.wire == "udp":
            assert isinstance(self.server, MbapServer)
            return [exchange.reply for exchange in self.server.receive_datagram(data, now_ns) if exchange.reply]
        if not data:
            return self.server.feed(b"", now_ns)
        said = []
        for end in range(len(data) % piece or piece, len(data) + 1, piece):
            at_ns = now_ns - (len(data) - end) * BYTE_NS
            said += self.server.feed(data[max(0, end - piece) : end], at_ns)
        return said

    def play(self, piece: int, tail: bytes = b"") -> int:
        """Run all steps; return the end of the last one."""
        now_ns = 0
        begin_ns = LONG_PAUSE_NS
        spoken = [step for step in self.vector["steps"] if step["hear"]]
        for step in self.vector["steps"]:
            heard = self.bytes_of(step["hear"])
            now_ns = begin_ns + round(step["at_ms"] * NS_PER_MS)
            last = step is spoken[-1]
            said = self.feed(heard + (tail if last and self.wire != "udp" else b""), now_ns, piece)
            assert said == [self.bytes_of(reply) for reply in step["say"]], f"at {step['at_ms']} ms"
        if self.wire == "udp" and tail:
            assert self.feed(tail, now_ns, piece) == []
        return now_ns

    def check_cells(self) -> None:
        for table in ("holding", "coil"):
            for address, value in self.vector.get(table, []):
                for number, unit in self.units.items():
                    assert unit.bank.peek(table, address) == value, f"unit {number}, {table} {address}"  # type: ignore[attr-defined]

    def check_counters(self) -> None:
        for name, value in self.vector.get("counters", {}).items():
            assert getattr(self.units[1].counters, name) == value, name
        for name, value in self.vector.get("line", {}).items():
            assert getattr(self.server.counters, name) == value, name  # type: ignore[union-attr]

    def check_alive(self, now_ns: int) -> None:
        """After any input, a request after a pause is answered; on a closed connection nothing is."""
        requests = {
            "ascii": (b":010100000001FD\r\n", 13),
            "mbap": (bytes.fromhex("0042 0000 0006 01 01 0000 0001"), 10),
        }
        request, length = requests.get(self.wire.replace("udp", "mbap"), (bytes.fromhex("01 01 0000 0001 FDCA"), 6))
        said = self.feed(request, now_ns + LONG_PAUSE_NS, len(request))
        said += self.server.feed(b"", now_ns + 2 * LONG_PAUSE_NS)
        if self.vector.get("closed"):
            assert said == []
            assert isinstance(self.server, MbapServer)
            assert self.server.desync is not None
        else:
            assert [len(reply) for reply in said] == [length], "the wire is wedged"


@pytest.mark.parametrize("vector", VECTORS, ids=ids)
def test_vector_in_one_piece(vector: dict[str, Any]) -> None:
    rig = Rig(vector)
    now_ns = rig.play(piece=1000)
    rig.check_cells()
    rig.check_counters()
    rig.check_alive(now_ns)


@pytest.mark.parametrize("piece", [1, 3])
@pytest.mark.parametrize("vector", [v for v in VECTORS if not v.get("whole_only")], ids=ids)
def test_vector_byte_by_byte(vector: dict[str, Any], piece: int) -> None:
    rig = Rig(vector)
    now_ns = rig.play(piece)
    rig.check_cells()
    rig.check_counters()
    rig.check_alive(now_ns)


TAILS = {
    "ascii": [b"00", b":0103", b"\xff\r\n"],
    "rtu": [b"\x00\x00", b"\xff\x55", b"\x07\x03\x02\x00", b"\x01\x03\x00"],
    "udp": [b"\x00", b"GET / HTTP/1.1\r\n", bytes(6)],
}


@pytest.mark.parametrize("number", range(4))
@pytest.mark.parametrize(
    "vector",
    [v for v in VECTORS if v.get("tail", True) and v.get("wire") != "mbap"],
    ids=ids,
)
def test_vector_followed_by_garbage(vector: dict[str, Any], number: int) -> None:
    tails = TAILS[vector.get("wire", "rtu")]
    rig = Rig(vector)
    now_ns = rig.play(1000, tails[number % len(tails)])
    rig.check_cells()
    rig.check_alive(now_ns)


@pytest.mark.parametrize("vector", [v for v in VECTORS if v.get("wire") == "mbap" and not v.get("closed")], ids=ids)
def test_vector_followed_by_half_an_adu(vector: dict[str, Any]) -> None:
    """In a TCP stream garbage cannot be distinguished; the following bytes are the next request, delivered completely later."""
    following = bytes.fromhex("0099 0000 0006 01 01 0000 0001")
    for cut in range(1, len(following)):
        rig = Rig(vector)
        now_ns = rig.play(1000, following[:cut])
        assert rig.feed(following[cut:], now_ns, 1000) == [bytes.fromhex("0099 0000 0004 01 01 01 00")]


def test_every_row_for_servers_has_a_vector() -> None:
    """Rows 10, 64 and 65 are about sockets and ports: tests/wires."""
    rows = {int(vector["id"][3:6]) for vector in VECTORS}
    wanted = {1, 4, 5, 7, 8, 9, 26, 27, *range(29, 58), 68, 69, 70}
    assert rows == wanted
    assert len({vector["id"] for vector in VECTORS}) == len(VECTORS)
