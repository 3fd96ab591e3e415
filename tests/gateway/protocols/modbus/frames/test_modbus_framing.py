"""Rows of the list of Modbus edge cases that need more than one vector, against the pure framings."""

from __future__ import annotations

import struct
from collections.abc import Iterable

import pytest

from fieldtwin.gateway.core.errors import CrcError, Desync, FieldtwinError, ReplyTimeout, UsageError, WrongSize
from fieldtwin.gateway.protocols.modbus.frames.crc import crc16, with_crc
from fieldtwin.gateway.protocols.modbus.frames.mbap import MbapFramer
from fieldtwin.gateway.protocols.modbus.frames.rtu import RtuFramer
from fieldtwin.gateway.protocols.modbus.requests.data import (
    MaskWriteRegister,
    ReadBits,
    ReadRegisters,
    ReadWriteRegisters,
    WriteCoils,
    WriteRegister,
    WriteRegisters,
)
from fieldtwin.gateway.protocols.modbus.requests.diagnostics import Diagnostics
from fieldtwin.gateway.protocols.modbus.requests.identity import ReadDeviceIdentification, ReportServerId
from fieldtwin.gateway.protocols.modbus.requests.replies import RegistersReply, Reply
from fieldtwin.gateway.protocols.modbus.requests.request import Request
from fieldtwin.gateway.protocols.modbus.transaction import Transaction

MS = 1_000_000
UNIT = 0x11
READ = ReadRegisters("holding", 0x6B, 3)
REPLY = with_crc(bytes.fromhex("11 03 06 02 2b 00 00 00 64"))
REGISTERS = (0x022B, 0, 0x64)
ECHO = with_crc(bytes([UNIT]) + READ.encode())


def exchange(framer: RtuFramer, arrivals: Iterable[tuple[float, bytes]], request: Request[Reply] = READ) -> Reply:
    """Start at 0; feed each (time in ms, bytes); then let time run out. Returns the reply or raises."""
    transaction = Transaction(framer, UNIT, request, timeout_ns=1000 * MS)
    transaction.start(0)
    for at_ms, data in arrivals:
        now_ns = round(at_ms * MS)
        while transaction.wake_ns < now_ns:
            reply = transaction.poll(transaction.wake_ns)
            if reply is not None:
                return reply
        reply = transaction.feed(data, now_ns)
        if reply is not None:
            return reply
    while True:
        reply = transaction.poll(transaction.wake_ns)
        if reply is not None:
            return reply


def registers(reply: Reply) -> tuple[int, ...]:
    assert isinstance(reply, RegistersReply)
    return reply.registers


def outcome(framer: RtuFramer, arrivals: Iterable[tuple[float, bytes]], request: Request[Reply] = READ) -> type:
    with pytest.raises(FieldtwinError) as caught:
        exchange(framer, arrivals, request)
    return caught.type


def test_crc_of_the_check_string_and_of_a_whole_frame() -> None:
    assert crc16(b"123456789") == 0x4B37  # CRC-16/MODBUS in the list of parametrised CRC algorithms
    assert crc16(REPLY) == 0


@pytest.mark.parametrize("length", [0, 1, 2, 3, 25, 255, 256, 257, 258, 1001])
def test_crc_is_that_of_the_shift_register(length: int) -> None:
    data = bytes((i * 89 + 7) & 0xFF for i in range(length))
    register = 0xFFFF  # SL 6.2.2.1, step by step
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = (register >> 1) ^ (0xA001 if register & 1 else 0)
    assert crc16(data) == crc16(bytearray(data)) == register


# 19200 8E1: a character takes 573 us, t1.5 is 859 us, t3.5 is 2005 us
CHAR_NS = 572_917


@pytest.mark.parametrize("gap_ms", [1.5, 16.0, 300.0])
def test_mb_005_mb_006_a_pause_inside_a_frame_is_accepted(gap_ms: float) -> None:
    reply = exchange(RtuFramer(char_time_ns=CHAR_NS), [(10, REPLY[:4]), (10 + gap_ms, REPLY[4:])])
    assert registers(reply) == REGISTERS


def test_mb_005_strict_discards_a_frame_with_a_pause_over_t15() -> None:
    strict = RtuFramer(strict=True, char_time_ns=CHAR_NS)
    arrivals = [(10.0, REPLY[:4]), (10.0 + 1.0 + 7 * 0.573, REPLY[4:])]
    with pytest.raises(ReplyTimeout, match="pause of 1 ms inside a frame"):
        exchange(strict, arrivals)
    assert strict.noise_bytes == len(REPLY)
    tolerable = [(10.0, REPLY[:4]), (10.0 + 0.5 + 7 * 0.573, REPLY[4:])]
    assert registers(exchange(strict, tolerable)) == REGISTERS


def test_mb_007_frames_closer_than_t35() -> None:
    foreign = with_crc(bytes.fromhex("12 03 02 00 01"))
    close = [(10.0, foreign), (10.0 + 1.0 + 11 * 0.573, REPLY)]
    assert registers(exchange(RtuFramer(char_time_ns=CHAR_NS), close)) == REGISTERS
    assert registers(exchange(RtuFramer(), [(10.0, foreign + REPLY)])) == REGISTERS
    strict = RtuFramer(strict=True, char_time_ns=CHAR_NS)
    with pytest.raises(ReplyTimeout, match="too soon"):
        exchange(strict, close)
    assert outcome(strict, [(10.0, foreign + REPLY)]) is ReplyTimeout
    apart = [(10.0, foreign), (10.0 + 2.1 + 11 * 0.573, REPLY)]
    assert registers(exchange(strict, apart)) == REGISTERS


def test_mb_009_trailing_zeros_are_dropped() -> None:
    framer = RtuFramer()
    assert registers(exchange(framer, [(10, REPLY + bytes(5))])) == REGISTERS
    assert (framer.noise_bytes, framer.late_bytes) == (5, 0)
    assert registers(exchange(framer, [(10, REPLY)])) == REGISTERS


@pytest.mark.parametrize("split", range(len(ECHO) + 1))
def test_mb_010_full_echo_is_stripped(split: int) -> None:
    framer = RtuFramer(echo=True)
    arrivals = [(1, ECHO[:split]), (2, ECHO[split:] + REPLY[:3]), (30, REPLY[3:])]
    assert registers(exchange(framer, arrivals)) == REGISTERS
    assert registers(exchange(framer, [(1, b"\x00\xff" + ECHO + b"\x00" + REPLY)])) == REGISTERS


def test_mb_010_the_echo_of_a_write_is_not_its_acknowledgement() -> None:
    write = WriteRegister(1, 3)
    echo = with_crc(bytes([UNIT]) + write.encode())
    assert outcome(RtuFramer(echo=True), [(1, echo)], write) is ReplyTimeout
    assert exchange(RtuFramer(echo=True), [(1, echo), (9, echo)], write).t_ns == 9 * MS


@pytest.mark.parametrize(
    "received",
    [ECHO[1:] + REPLY, ECHO[:3] + REPLY, ECHO[:3] + b"\x80" + ECHO[4:] + REPLY, REPLY, ECHO[:5]],
    ids=["head lost", "tail lost", "corrupt", "no echo", "nothing more"],
)
def test_mb_011_a_damaged_echo_is_an_error_and_never_data(received: bytes) -> None:
    assert outcome(RtuFramer(echo=True), [(1, received)]) in (Desync, ReplyTimeout)
    assert outcome(RtuFramer(echo=True), [(i, bytes([b])) for i, b in enumerate(received)]) in (Desync, ReplyTimeout)


def test_mb_012_a_late_reply_of_another_shape_is_never_data() -> None:
    framer = RtuFramer()
    assert outcome(framer, []) is ReplyTimeout
    late = with_crc(bytes.fromhex("11 03 02 00 07"))
    assert outcome(framer, [(1, late), (5, REPLY)]) is WrongSize
    assert registers(exchange(framer, [(1, REPLY)])) == REGISTERS


def test_mb_014_a_duplicate_reply_is_ignored() -> None:
    framer = RtuFramer()
    assert registers(exchange(framer, [(1, REPLY + REPLY)])) == REGISTERS
    assert framer.late_bytes == len(REPLY)


def test_mb_015_the_reply_timer_keeps_running() -> None:
    foreign = with_crc(bytes.fromhex("12 03 02 00 01"))
    framer = RtuFramer()
    transaction = Transaction(framer, UNIT, READ, timeout_ns=100 * MS, char_time_ns=CHAR_NS)
    transaction.start(0)
    due = transaction.deadline_ns
    for at_ms in range(0, 100, 10):
        assert transaction.feed(foreign, at_ms * MS) is None
        assert transaction.deadline_ns == due
    with pytest.raises(ReplyTimeout, match="frame of unit 18"):
        transaction.poll(due)
    assert framer.foreign_frames == 10


@pytest.mark.parametrize("bytewise", [False, True])
def test_mb_015_our_reply_inside_a_foreign_frame_is_foreign_data(bytewise: bool) -> None:
    wrapped = with_crc(b"\x12\x03" + bytes([len(REPLY) + 1]) + REPLY + b"\x00")
    arrivals = [(i, bytes([b])) for i, b in enumerate(wrapped)] if bytewise else [(1, wrapped)]
    assert outcome(RtuFramer(), arrivals) is ReplyTimeout
    other = REPLY[:3] + b"\x00\x01\x00\x02\x00\x03"
    assert registers(exchange(RtuFramer(), [*arrivals, (100, with_crc(other))])) == (1, 2, 3)


def test_a_foreign_frame_that_never_ends_is_waited_for_until_the_line_is_silent() -> None:
    head = bytes.fromhex("12 03 c8 00 01")  # announces 200 bytes
    assert registers(exchange(RtuFramer(), [(1, head), (5, REPLY)])) == REGISTERS


def test_mb_021_an_exception_is_seen_with_its_fifth_byte() -> None:
    transaction = Transaction(RtuFramer(), UNIT, ReadRegisters("holding", 0, 125), timeout_ns=1000 * MS)
    transaction.start(0)
    exception = with_crc(bytes.fromhex("11 83 02"))
    for i, byte in enumerate(exception[:-1]):
        assert transaction.feed(bytes([byte]), i) is None
    with pytest.raises(FieldtwinError, match="02h"):
        transaction.feed(exception[-1:], 9)


def test_mb_050_a_frame_of_256_bytes_is_accepted_and_one_of_257_is_not() -> None:
    longest = with_crc(bytes([UNIT, 0x11, 251]) + bytes(251))
    assert len(longest) == 256
    assert len(exchange(RtuFramer(), [(1, longest)], ReportServerId()).raw) == 251
    over = with_crc(bytes([UNIT, 0x11, 252]) + bytes(252))
    assert outcome(RtuFramer(), [(1, over)], ReportServerId()) in (Desync, CrcError)


def test_garbage_is_bounded() -> None:
    framer = RtuFramer()
    transaction = Transaction(framer, UNIT, READ, timeout_ns=1000 * MS)
    transaction.start(0)
    for at in range(200):
        transaction.feed(bytes([0x55, 0xAA, 0x10, 0x33]) * 16, at)
        assert len(framer._buffer) <= 256 + 64
    with pytest.raises(CrcError, match="baud rate"):
        transaction.poll(transaction.deadline_ns)


# -- MBAP ---------------------------------------------------------------------------------------------------------

PDU = bytes.fromhex("03 06 02 2b 00 00 00 64")


def adu(transaction: int, pdu: bytes = PDU, unit: int = UNIT, protocol: int = 0, length: int | None = None) -> bytes:
    return struct.pack(">HHHB", transaction, protocol, len(pdu) + 1 if length is None else length, unit) + pdu


def ask(framer: MbapFramer, received: bytes, bytewise: bool = False, request: Request[Reply] = READ) -> Reply:
    transaction = Transaction(framer, UNIT, request, timeout_ns=1000 * MS)
    transaction.start(0)
    for chunk in [received[i : i + 1] for i in range(len(received))] if bytewise else [received]:
        reply = transaction.feed(chunk, 1)
        if reply is not None:
            return reply
    transaction.poll(transaction.deadline_ns)
    raise AssertionError("neither reply nor error")


@pytest.mark.parametrize("bytewise", [False, True])
def test_mb_050_an_adu_of_260_bytes_is_accepted_and_one_of_261_is_not(bytewise: bool) -> None:
    longest = bytes([0x11, 251]) + bytes(251)
    assert len(ask(MbapFramer(), adu(1, longest), bytewise, ReportServerId()).raw) == 251
    framer = MbapFramer()
    with pytest.raises(ReplyTimeout):
        ask(framer, adu(1, bytes([0x11, 252]) + bytes(252)), bytewise, ReportServerId())
    assert registers(ask(framer, adu(2), bytewise)) == REGISTERS


@pytest.mark.parametrize("length", [0, 1, 255, 256, 0xFFFF])
@pytest.mark.parametrize("bytewise", [False, True])
def test_mb_055_a_bad_length_never_wedges(length: int, bytewise: bool) -> None:
    framer = MbapFramer()
    with pytest.raises(ReplyTimeout, match=f"length {length}"):
        ask(framer, adu(1, length=length), bytewise)
    for transaction in (2, 3):
        assert registers(ask(framer, adu(transaction), bytewise)) == REGISTERS


@pytest.mark.parametrize("cut", range(1, 15))
def test_mb_055_an_adu_that_never_ends_costs_one_exchange(cut: int) -> None:
    framer = MbapFramer()
    with pytest.raises(ReplyTimeout):
        ask(framer, adu(1)[:cut])
    assert registers(ask(framer, adu(2))) == REGISTERS
    with pytest.raises(ReplyTimeout):
        ask(framer, adu(3)[:cut])
    assert registers(ask(framer, adu(3)[cut:] + adu(4))) == REGISTERS  # the rest came late


@pytest.mark.parametrize("cut", range(1, 15))
def test_mb_055_bytes_from_before_a_request_do_not_belong_to_its_reply(cut: int) -> None:
    framer = MbapFramer()
    with pytest.raises(ReplyTimeout):
        ask(framer, adu(2)[:cut])  # the beginning of a reply with the ID that the next request will have
    assert registers(ask(framer, adu(2))) == REGISTERS


def test_mb_056_a_late_reply_is_recognised_by_its_transaction_id() -> None:
    framer = MbapFramer()
    with pytest.raises(ReplyTimeout):
        ask(framer, b"")
    stale = adu(1, bytes.fromhex("03 06 00 01 00 01 00 01"))
    assert registers(ask(framer, stale + adu(2) + adu(2))) == REGISTERS
    assert framer.late_bytes == len(stale) + len(adu(2))


def test_mb_056_transaction_ids_skip_zero_when_they_wrap() -> None:
    framer = MbapFramer()
    seen = [framer.begin(UNIT, READ)[:2] for _ in range(0x10001)]
    assert seen[0] == b"\x00\x01"
    assert seen[0xFFFE:0x10000] == [b"\xff\xff", b"\x00\x01"]
    assert b"\x00\x00" not in seen


# -- requests -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "make",
    [
        lambda: ReadRegisters("holding", 0, 0),
        lambda: ReadRegisters("holding", 0, 126),
        lambda: ReadRegisters("holding", -1, 1),
        lambda: ReadRegisters("holding", 65535, 2),
        lambda: ReadRegisters("coil", 0, 1),  # type: ignore[arg-type]
        lambda: ReadBits("coil", 0, 2001),
        lambda: ReadBits("input", 0, 1),  # type: ignore[arg-type]
        lambda: WriteRegister(0, 65536),
        lambda: WriteRegister(0, -1),
        lambda: WriteRegisters(0, ()),
        lambda: WriteRegisters(0, (0,) * 124),
        lambda: WriteRegisters(0, (65536,)),
        lambda: WriteCoils(0, (True,) * 1969),
        lambda: MaskWriteRegister(0, 65536, 0),
        lambda: ReadWriteRegisters(0, 1, 0, (0,) * 122),
        lambda: Diagnostics(4),
        lambda: ReadDeviceIdentification(5),
    ],
)
def test_requests_that_the_standard_forbids_cannot_be_made(make: object) -> None:
    assert callable(make)
    with pytest.raises(UsageError):
        make()


@pytest.mark.parametrize(
    "request_",
    [
        ReadRegisters("input", 65411, 125),
        ReadBits("discrete", 63536, 2000),
        WriteRegisters(65413, tuple(range(123))),
        WriteCoils(63568, (True, False) * 984),
        ReadWriteRegisters(0, 125, 65415, (0xFFFF,) * 121),
    ],
)
def test_the_largest_requests_fit(request_: Request[Reply]) -> None:
    assert len(request_.encode()) <= 253
    assert len(RtuFramer().begin(247, request_)) <= 256
