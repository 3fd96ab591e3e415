"""Our client against our emulated server, which share no code, on a damaging wire: typed errors or the right value.

After any damage, the next exchange over an intact wire succeeds: both sides are synchronised again.
"""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.emulators.modbus.ascii import AsciiServer
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.errors import FieldtwinError, ModbusExceptionReply
from fieldtwin.gateway.protocols.modbus.frames.ascii import AsciiFramer
from fieldtwin.gateway.protocols.modbus.frames.framing import Framer
from fieldtwin.gateway.protocols.modbus.frames.mbap import MbapFramer, UdpFramer
from fieldtwin.gateway.protocols.modbus.frames.rtu import RtuFramer
from fieldtwin.gateway.protocols.modbus.requests.data import (
    ReadBits,
    ReadRegisters,
    ReadWriteRegisters,
    WriteCoil,
    WriteCoils,
    WriteRegister,
    WriteRegisters,
)
from fieldtwin.gateway.protocols.modbus.requests.replies import Reply
from fieldtwin.gateway.protocols.modbus.requests.request import Request
from fieldtwin.gateway.protocols.modbus.server.analysis import examine
from fieldtwin.gateway.protocols.modbus.transaction import Transaction

UNIT = 1
TIMEOUT_NS = 200_000_000
PAUSE_NS = 3_000_000_000
FIRST = 1000
KINDS = ["rtu", "ascii", "mbap", "udp"]


def make_unit(cells: int = 500) -> ModbusUnit:
    bank = MapBank([CellSpan(table, 0, cells) for table in ("coil", "discrete", "holding", "input")])
    bank.poke("holding", 0, *(FIRST + i for i in range(200)))
    bank.poke("input", 0, *(2 * FIRST + i for i in range(200)))
    bank.poke("coil", 0, *(i % 3 == 0 for i in range(64)))
    bank.poke("discrete", 0, *(i % 5 == 0 for i in range(64)))
    return ModbusUnit(bank)


class Rig:
    """One client, one server, and the clock."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        framers = {"rtu": RtuFramer, "ascii": AsciiFramer, "mbap": MbapFramer, "udp": UdpFramer}
        self.framer: Framer = framers[kind]()
        self.unit = make_unit()
        units = {UNIT: self.unit}
        self.line = {"rtu": RtuServer, "ascii": AsciiServer}.get(kind, RtuServer)(units)
        self.stream = MbapServer(units)
        self.now_ns = 0

    def heard(self, data: bytes) -> list[bytes]:
        """Return the reply of the server."""
        if self.kind == "udp":
            return [e.reply for e in self.stream.receive_datagram(data, self.now_ns) if e.reply]
        if self.kind == "mbap":
            return self.stream.feed(data, self.now_ns)
        replies: list[bytes] = self.line.feed(data, self.now_ns)
        return replies

    def exchange(
        self, request: Request[Reply], damage_out: list[bytes] | None = None, damage_back: Damage | None = None
    ) -> Reply | FieldtwinError:
        """Send a request. `damage_out` changes the bytes to the server, `damage_back` the reply."""
        transaction = Transaction(self.framer, UNIT, request, timeout_ns=TIMEOUT_NS)
        sent = transaction.start(self.now_ns)
        arrived = [sent] if damage_out is None else damage_out
        replies = [reply for data in arrived for reply in self.heard(data)]
        if self.kind in ("rtu", "ascii"):  # a damaged request ends with the silence after it
            self.now_ns += 60_000_000
            replies += self.heard(b"")
        try:
            for reply in replies:
                for chunk in [reply] if damage_back is None else damage_back.of(reply, self.kind):
                    self.now_ns += 1_000_000
                    answer = transaction.feed(chunk, self.now_ns)
                    if answer is not None:
                        return answer
            while True:
                self.now_ns = max(self.now_ns, transaction.wake_ns)
                answer = transaction.poll(self.now_ns)
                if answer is not None:
                    return answer
        except FieldtwinError as e:
            return e

    def settle(self) -> None:
        """A pause longer than any quarantine; the owner of a connection closes it if the server cannot parse it."""
        self.now_ns += PAUSE_NS
        self.heard(b"") if self.kind in ("rtu", "ascii") else None
        self.now_ns += PAUSE_NS


class Damage:
    """Damage bytes: one burst of at most 16 bits, which every checksum finds; a cut; or a complete repetition."""

    def __init__(self, where: int, burst: int, cut: int, twice: bool, pieces: int) -> None:
        self.where, self.burst, self.cut, self.twice, self.pieces = where, burst, cut, twice, pieces

    def of(self, data: bytes, kind: str) -> list[bytes]:
        if kind == "rtu" and self.burst:
            bits = len(data) * 8
            flipped = int.from_bytes(data) ^ self.burst << self.where % bits & (1 << bits) - 1
            data = flipped.to_bytes(len(data))
        elif kind == "ascii" and self.burst:  # the checksum detects a change of one byte
            at = self.where % len(data)
            data = data[:at] + bytes([data[at] ^ (self.burst & 0xFF or 1)]) + data[at + 1 :]
        if self.cut and kind != "mbap":  # TCP loses nothing
            data = data[: -self.cut] if self.cut < len(data) else b""
        if kind == "udp":
            return [data] * (1 + self.twice)
        data *= 1 + self.twice
        return [data[i : i + self.pieces] for i in range(0, len(data), self.pieces)]


DAMAGES = st.builds(
    Damage,
    st.integers(0, 3000),
    st.one_of(st.just(0), st.integers(1, 0xFFFF)),
    st.sampled_from([0, 0, 0, 1, 2, 7]),
    st.booleans(),
    st.integers(1, 300),
)

REQUESTS = st.one_of(
    st.builds(ReadRegisters, st.sampled_from(["holding", "input"]), st.integers(0, 60), st.integers(1, 125)),
    st.builds(ReadBits, st.sampled_from(["coil", "discrete"]), st.integers(0, 20), st.integers(1, 40)),
    st.builds(WriteRegister, st.integers(300, 310), st.integers(0, 0xFFFF)),
    st.builds(WriteCoil, st.integers(300, 310), st.booleans()),
    st.builds(WriteRegisters, st.just(320), st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=123).map(tuple)),
    st.builds(WriteCoils, st.just(320), st.lists(st.booleans(), min_size=1, max_size=40).map(tuple)),
    st.builds(ReadWriteRegisters, st.integers(0, 60), st.integers(1, 60), st.just(400), st.just((7, 8))),
)


def is_true(rig: Rig, request: Request[Reply], reply: Reply) -> bool:
    """Return whether the reply matches the server's values."""
    if isinstance(request, ReadRegisters | ReadWriteRegisters):
        table = request.table if isinstance(request, ReadRegisters) else "holding"
        first = 2 * FIRST if table == "input" else FIRST
        at = request.address if isinstance(request, ReadRegisters) else request.read_address
        words = reply.registers  # type: ignore[attr-defined]
        return list(words) == [first + at + i for i in range(len(words))]
    if isinstance(request, ReadBits):
        every = 3 if request.table == "coil" else 5
        bits = reply.bits  # type: ignore[attr-defined]
        return list(bits) == [(request.address + i) % every == 0 for i in range(len(bits))]
    if isinstance(request, WriteRegister | WriteCoil):
        cells = "holding" if isinstance(request, WriteRegister) else "coil"
        return bool(rig.unit.bank.peek(cells, request.address) == int(request.value))  # type: ignore[attr-defined]
    if isinstance(request, WriteRegisters | WriteCoils):
        cells = "holding" if isinstance(request, WriteRegisters) else "coil"
        held = [rig.unit.bank.peek(cells, 320 + i) for i in range(len(request.values))]  # type: ignore[attr-defined]
        return held == [int(v) for v in request.values]
    return False


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(KINDS), st.lists(st.tuples(REQUESTS, DAMAGES), min_size=1, max_size=3))
def test_damaged_replies_are_errors_or_true(kind: str, exchanges: list[tuple[Request[Reply], Damage]]) -> None:
    rig = Rig(kind)
    for request, damage in exchanges:
        outcome = rig.exchange(request, damage_back=damage)
        assert isinstance(outcome, FieldtwinError) or is_true(rig, request, outcome), outcome
        rig.settle()
    last = ReadRegisters("holding", 3, 4)
    answer = rig.exchange(last)
    assert isinstance(answer, Reply), answer
    assert is_true(rig, last, answer)


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(["rtu", "ascii", "udp"]), REQUESTS, DAMAGES)
def test_damaged_requests_are_silence_refusal_or_true(kind: str, request: Request[Reply], damage: Damage) -> None:
    rig = Rig(kind)
    framer = Rig(kind).framer
    sent = Transaction(framer, UNIT, request, timeout_ns=TIMEOUT_NS).start(0)
    outcome = rig.exchange(request, damage_out=damage.of(sent, kind))
    assert isinstance(outcome, FieldtwinError) or is_true(rig, request, outcome), outcome
    rig.settle()
    last = ReadRegisters("holding", 3, 4)
    answer = rig.exchange(last)
    assert isinstance(answer, Reply), answer
    assert is_true(rig, last, answer)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.binary(max_size=300), max_size=6))
def test_datagrams_of_anything_never_raise_and_the_next_is_answered(datagrams: list[bytes]) -> None:
    rig = Rig("udp")
    for datagram in datagrams:
        for reply in rig.heard(datagram):
            assert len(reply) == 6 + int.from_bytes(reply[4:6])
    assert isinstance(rig.exchange(ReadRegisters("holding", 0, 1)), Reply)


ADDRESSES = st.one_of(st.sampled_from([0, 0xFFF0, 0xFFFE, 0xFFFF]), st.integers(0, 0xFFFF))
COUNTS = st.one_of(
    st.sampled_from([0, 1, 2, 7, 8, 9, 121, 122, 123, 124, 125, 126, 1968, 1969, 2000, 2001]), st.integers(0, 0xFFFF)
)
OFF_BY = st.sampled_from([0, 0, 0, -1, 1])


def words(*values: int) -> bytes:
    return b"".join(value.to_bytes(2) for value in values)


def write_many(function: int, address: int, count: int, off_by: int, short_by: int) -> bytes:
    """A write of several cells with a byte count and data that may be one too many or too few."""
    size = (count + 7) // 8 if function == 0x0F else 2 * count
    data = bytes(max(0, min(size, 246) - short_by))
    return bytes([function]) + words(address, count) + bytes([max(0, size + off_by) & 0xFF]) + data


def read_write(address: int, count: int, to: int, given: int, off_by: int) -> bytes:
    size = max(0, min(2 * given, 242) + off_by)
    return b"\x17" + words(address, count, to, given) + bytes([size]) + bytes(size)


SENSIBLE = st.one_of(
    st.binary(min_size=1, max_size=253),
    st.builds(
        lambda function, address, count, more: bytes([function]) + words(address, count) + more,
        st.integers(1, 6), ADDRESSES, st.one_of(COUNTS, st.sampled_from([0xFF00, 0xFF01])), st.sampled_from([b"", b"\0"]),
    ),
    st.builds(write_many, st.sampled_from([0x0F, 0x10]), ADDRESSES, COUNTS, OFF_BY, OFF_BY),
    st.builds(read_write, ADDRESSES, COUNTS, ADDRESSES, COUNTS, OFF_BY),
    st.builds(lambda *values: b"\x16" + words(*values), ADDRESSES, ADDRESSES, ADDRESSES),
)  # fmt: skip
WHOLE = make_unit(0x10000)
JUDGED = {1, 2, 3, 4, 5, 6, 0x0F, 0x10, 0x16, 0x17}
"""Functions that both sides know, and that depend only on the request if every cell exists."""


@settings(max_examples=400, deadline=None)
@given(SENSIBLE)
def test_both_servers_check_a_request_identically(pdu: bytes) -> None:
    """The emulator and the gateway's own server: the same exception, or neither refuses."""
    if pdu[0] not in JUDGED:
        return
    try:
        examine(pdu)
        code = 0
    except ModbusExceptionReply as e:
        code = e.code
    said = WHOLE.respond(pdu, 0)
    assert said is not None
    assert said[0] & 0x7F == pdu[0]
    assert (said[1] if said[0] & 0x80 else 0) == code


@pytest.mark.parametrize("kind", KINDS)
def test_client_and_server_agree_without_damage(kind: str) -> None:
    """Premises of the properties: an undamaged exchange is correct, and a wrong value would be detected."""
    rig = Rig(kind)
    request = ReadRegisters("holding", 5, 3)
    reply = rig.exchange(request)
    assert isinstance(reply, Reply)
    assert is_true(rig, request, reply)
    assert not is_true(rig, ReadRegisters("holding", 6, 3), reply)
