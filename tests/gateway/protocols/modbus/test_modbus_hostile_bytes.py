"""For any bytes in any pieces: never a wrong value, never a third-party exception, and the next request is answered."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymodbus.pdu.bit_message import ReadCoilsResponse
from pymodbus.pdu.register_message import ReadHoldingRegistersResponse

from fieldtwin.gateway.core.errors import FieldtwinError, ReplyTimeout, WireError
from fieldtwin.gateway.protocols.modbus.frames.ascii import AsciiFramer, lrc
from fieldtwin.gateway.protocols.modbus.frames.crc import with_crc
from fieldtwin.gateway.protocols.modbus.frames.framing import Framer
from fieldtwin.gateway.protocols.modbus.frames.mbap import MbapFramer, UdpFramer
from fieldtwin.gateway.protocols.modbus.frames.rtu import MOST_HUNTED, RtuFramer
from fieldtwin.gateway.protocols.modbus.requests.data import (
    MaskWriteRegister,
    ReadBits,
    ReadRegisters,
    ReadWriteRegisters,
    WriteCoil,
    WriteCoils,
    WriteRegister,
    WriteRegisters,
    pdus,
)
from fieldtwin.gateway.protocols.modbus.requests.diagnostics import (
    Diagnostics,
    GetCommEventCounter,
    GetCommEventLog,
    Loopback,
)
from fieldtwin.gateway.protocols.modbus.requests.files import FileSpan, ReadFifoQueue, ReadFileRecords, WriteFileRecords
from fieldtwin.gateway.protocols.modbus.requests.identity import (
    ReadDeviceIdentification,
    ReadExceptionStatus,
    ReportServerId,
)
from fieldtwin.gateway.protocols.modbus.requests.replies import RegistersReply, Reply
from fieldtwin.gateway.protocols.modbus.requests.request import Request, parse_reply
from fieldtwin.gateway.protocols.modbus.requests.user import CountedShape, FixedShape, UserFunction
from fieldtwin.gateway.protocols.modbus.transaction import Transaction

UNIT = 1
TIMEOUT_NS = 1_000_000_000

REQUESTS = st.one_of(
    st.builds(ReadRegisters, st.sampled_from(["holding", "input"]), st.integers(0, 999), st.integers(1, 125)),
    st.builds(ReadBits, st.sampled_from(["coil", "discrete"]), st.integers(0, 999), st.integers(1, 2000)),
    st.builds(WriteRegister, st.integers(0, 65535), st.integers(0, 65535)),
    st.builds(WriteRegisters, st.just(7), st.lists(st.integers(0, 65535), min_size=1, max_size=123).map(tuple)),
    st.just(ReportServerId()),
    st.just(ReadDeviceIdentification()),
    st.just(GetCommEventLog()),
    st.just(ReadFifoQueue(7)),
    st.builds(UserFunction, st.integers(65, 72), st.binary(max_size=8), st.builds(FixedShape, st.integers(6, 40))),
    st.builds(
        UserFunction,
        st.integers(100, 110),
        st.binary(max_size=8),
        st.builds(CountedShape, st.integers(0, 3), st.integers(1, 2), st.integers(0, 3)),
    ),
)

ALL_REQUESTS = st.one_of(
    REQUESTS,
    st.sampled_from(
        [
            WriteCoil(1, True),
            WriteCoils(1, (True, False)),
            MaskWriteRegister(1, 2, 3),
            ReadWriteRegisters(1, 2, 3, (4,)),
            Diagnostics(0x0B),
            Loopback(b"abcd"),
            GetCommEventCounter(),
            ReadExceptionStatus(),
            ReadFileRecords((FileSpan(1, 2, 3), FileSpan(4, 5, 1))),
            WriteFileRecords(((1, 2, (3, 4)),)),
            ReadDeviceIdentification(4, 2),
        ]
    ),
)

# Bytes with a meaning: units, functions and counts in use, whole frames of ours and of third parties.
CRUMBS = st.one_of(
    st.binary(max_size=12),
    st.sampled_from([b"\x01\x03", b"\x01\x83", b"\x01\x04\x04", b"\x01", b"\x00", b"\xff", b"\x02\x03\xfa"]),
    st.sampled_from([bytes.fromhex(h) for h in ("02 03 02 00 07", "02 83 02", "02 06 00 01 00 02")]).map(with_crc),
    st.sampled_from([bytes.fromhex(h) for h in ("00 01 00 00", "00 01 00 00 00 05 02", "00 00 00 00 ff ff")]),
    st.sampled_from([b":", b"\r\n", b":0103", b":02030200", b":0183020", b":020302000AEF\r\n", b":010302000AEF\r\n"]),
)
GARBAGE = st.lists(CRUMBS, max_size=12).map(b"".join)
SPLITS = st.lists(st.tuples(st.integers(1, 40), st.integers(0, 40_000_000)), max_size=40)


def framer_of(kind: str, echo: bool = False, strict: bool = False) -> Framer:
    if kind == "mbap":
        return MbapFramer()
    if kind == "zero id":
        return MbapFramer(accepts_zero_id=True)
    if kind == "udp":
        return UdpFramer()
    if kind == "ascii":
        return AsciiFramer(echo=echo)
    return RtuFramer(echo=echo, strict=strict, char_time_ns=573_000 if strict else 0)


def play(framer: Framer, request: Request[Reply], data: bytes, splits: list[tuple[int, int]]) -> Reply | FieldtwinError:
    """Deliver `data` in pieces of the sizes and at the intervals of `splits`, the rest at once; then let time pass."""
    transaction = Transaction(framer, UNIT, request, timeout_ns=TIMEOUT_NS)
    now_ns = 0
    transaction.start(now_ns)
    try:
        for size, pause_ns in [*splits, (len(data), 0)]:
            now_ns += pause_ns
            while transaction.wake_ns <= now_ns:
                reply = transaction.poll(transaction.wake_ns)
                if reply is not None:
                    return reply
            piece, data = data[:size], data[size:]
            if piece:
                reply = transaction.feed(piece, now_ns)
                if reply is not None:
                    return reply
        while True:
            reply = transaction.poll(transaction.wake_ns)
            if reply is not None:
                return reply
    except FieldtwinError as e:
        return e


def framed(kind: str, transaction: int, pdu: bytes, unit: int = UNIT) -> bytes:
    if kind == "ascii":
        frame = bytes([unit]) + pdu
        return b":" + (frame + bytes([lrc(frame)])).hex().upper().encode() + b"\r\n"
    if kind != "rtu":
        return transaction.to_bytes(2, "big") + b"\x00\x00" + (len(pdu) + 1).to_bytes(2, "big") + bytes([unit]) + pdu
    return with_crc(bytes([unit]) + pdu)


def registers_pdu(function: int, values: list[int]) -> bytes:
    return bytes([function, 2 * len(values)]) + b"".join(v.to_bytes(2, "big") for v in values)


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(["rtu", "mbap", "udp", "ascii"]), st.booleans(), st.booleans(), REQUESTS, GARBAGE, SPLITS)
def test_garbage_gives_typed_errors_only_and_the_next_exchange_works(
    kind: str, echo: bool, strict: bool, request: Request[Reply], garbage: bytes, splits: list[tuple[int, int]]
) -> None:
    framer = framer_of(kind, echo, strict)
    outcome = play(framer, request, garbage, splits)
    assert isinstance(outcome, FieldtwinError), f"a value out of garbage: {outcome}"
    read = ReadRegisters("holding", 0, 2)
    reply = framed(kind, 2, registers_pdu(3, [7, 0xFFFF]))
    echoed = framed(kind, 0, read.encode()) if echo and kind in ("rtu", "ascii") else b""
    answer = play(framer, read, echoed + reply, [])
    assert isinstance(answer, RegistersReply)
    assert answer.registers == (7, 0xFFFF)


@settings(max_examples=200, deadline=None)
@given(
    st.sampled_from(["rtu", "mbap", "zero id", "ascii"]),
    st.lists(st.integers(0, 65535), min_size=1, max_size=125),
    SPLITS,
    st.lists(st.sampled_from([b"\x00", b"\xff"]), max_size=5).map(b"".join),
)
def test_a_reply_is_read_whatever_its_pieces(
    kind: str, values: list[int], splits: list[tuple[int, int]], noise: bytes
) -> None:
    data = framed(kind, 1, registers_pdu(4, values))
    if kind in ("rtu", "ascii"):
        data = noise + data
    outcome = play(framer_of(kind), ReadRegisters("input", 0, len(values)), data, splits)
    if isinstance(outcome, ReplyTimeout):
        assert sum(pause for _, pause in splits) >= TIMEOUT_NS
        return
    assert isinstance(outcome, RegistersReply)
    assert outcome.registers == tuple(values)
    assert outcome.raw == b"".join(v.to_bytes(2, "big") for v in values)


@settings(max_examples=300, deadline=None)
@given(st.lists(st.integers(0, 65535), min_size=1, max_size=20), st.data())
def test_a_damaged_rtu_reply_is_never_a_value(values: list[int], data: st.DataObject) -> None:
    """A burst of up to 16 bits is always found by the CRC; a lost or cut part is found by the length."""
    frame = framed("rtu", 0, registers_pdu(3, values))
    at = data.draw(st.integers(0, len(frame) * 8 - 1))
    burst = data.draw(st.integers(1, 0xFFFF)) << at
    damaged = (int.from_bytes(frame, "big") ^ (burst & ((1 << len(frame) * 8) - 1))).to_bytes(len(frame), "big")
    cut = data.draw(st.integers(0, len(frame) - 1))
    request = ReadRegisters("holding", 0, len(values))
    for received in (damaged, frame[:cut], frame[:cut] + frame[cut + 1 :]):
        if received != frame:
            assert isinstance(play(RtuFramer(), request, received, []), FieldtwinError)


@settings(max_examples=300, deadline=None)
@given(
    st.sampled_from(["rtu", "mbap", "zero id", "ascii"]),
    st.integers(1, 20),
    st.lists(st.integers(0, 65535), min_size=1, max_size=20),
    st.sampled_from([1, 2, 3, 4, 6, 16, 23]),
    st.integers(1, 3),
    SPLITS,
)
def test_a_valid_frame_is_a_value_only_if_it_answers_the_request(
    kind: str, count: int, values: list[int], function: int, unit: int, splits: list[tuple[int, int]]
) -> None:
    data = framed(kind, 1, registers_pdu(function, values), unit)
    outcome = play(framer_of(kind), ReadRegisters("holding", 0, count), data, splits)
    if (function, unit, len(values)) == (3, UNIT, count) and sum(pause for _, pause in splits) < TIMEOUT_NS:
        assert isinstance(outcome, RegistersReply)
    elif isinstance(outcome, RegistersReply):
        assert (function, unit, outcome.registers) == (3, UNIT, tuple(values))
    else:
        assert isinstance(outcome, WireError)


@settings(max_examples=500, deadline=None)
@given(ALL_REQUESTS, st.binary(max_size=260), st.booleans(), st.data())
def test_any_pdu_is_a_reply_or_a_typed_error(
    request: Request[Reply], tail: bytes, refused: bool, data: st.DataObject
) -> None:
    head = bytes([request.function | (0x80 if refused else 0)])
    size = request.nominal_length() or data.draw(st.integers(1, 253))
    for pdu in (tail, head + tail, (head + tail).ljust(size, b"\x00")[:size]):
        try:
            reply = parse_reply(request, pdu, 1)
        except FieldtwinError:
            continue
        assert isinstance(reply, Reply)
        assert pdu[0] == request.function


@given(st.lists(st.integers(0, 65535), min_size=1, max_size=125), st.binary(min_size=1, max_size=250))
def test_words_and_bits_match_those_of_pymodbus(words: list[int], packed: bytes) -> None:
    registers = ReadHoldingRegistersResponse()
    raw = pdus.words_to_bytes(words)
    registers.decode(bytes([len(raw)]) + raw)
    assert pdus.words_of(raw) == tuple(registers.registers) == tuple(words)
    coils = ReadCoilsResponse()
    coils.decode(bytes([len(packed)]) + packed)
    assert pdus.bits_of(packed) == tuple(coils.bits)


FLOODS = [
    bytes(range(256)) * 256,
    bytes(65536),
    b"\x01\x03" * 32768,
    b":\n" * 32768,
    b"\x00\x01\x00\x00" * 16384,
    b"\n" * 65536,
]


@pytest.mark.parametrize("kind", ["rtu", "mbap", "udp", "ascii"])
@pytest.mark.parametrize("flood", FLOODS, ids=["every byte", "zeros", "ours", "colons", "headers", "line feeds"])
def test_a_flood_of_garbage_is_bounded_in_memory_and_in_work(kind: str, flood: bytes) -> None:
    """While a reply is awaited: 100 MB of every byte, 1 MB of meaningful bytes. The test's time limit bounds the work: at 2 us
    a byte, 100 MB would take minutes."""
    framer = framer_of(kind)
    transaction = Transaction(framer, UNIT, ReadRegisters("holding", 0, 2), timeout_ns=TIMEOUT_NS)
    transaction.start(0)
    for i in range(1600 if flood is FLOODS[0] else 16):
        try:
            transaction.feed(flood, i)
        except FieldtwinError:
            break
        assert len(framer._buffer) <= 600  # type: ignore[attr-defined]
    answer = play(framer, ReadRegisters("holding", 0, 1), framed(kind, 2, registers_pdu(3, [9])), [])
    assert isinstance(answer, RegistersReply)
    assert answer.registers == (9,)


def test_a_reply_after_more_noise_than_is_searched_is_given_up() -> None:
    read, reply = ReadRegisters("holding", 0, 1), framed("rtu", 0, registers_pdu(3, [9]))
    assert isinstance(play(RtuFramer(), read, b"\x55" * (MOST_HUNTED - 300) + reply, []), RegistersReply)
    outcome = play(RtuFramer(), read, b"\x55" * (MOST_HUNTED + 300) + reply, [])
    assert isinstance(outcome, WireError)
    assert "baud rate" in str(outcome)
