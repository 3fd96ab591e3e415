"""Parsing of client requests: any bytes, in any pieces. Only Modbus's own exceptions, never a wrong frame boundary."""

from __future__ import annotations

import struct
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.errors import ModbusExceptionReply, UsageError
from fieldtwin.gateway.protocols.modbus.frames.crc import crc16, with_crc
from fieldtwin.gateway.protocols.modbus.frames.selection import make_framer
from fieldtwin.gateway.protocols.modbus.server.analysis import READ_FUNCTIONS, Access, examine
from fieldtwin.gateway.protocols.modbus.server.forward import Forwarded
from fieldtwin.gateway.protocols.modbus.server.line import LineRequest, RtuRequests
from fieldtwin.gateway.protocols.modbus.server.mbap import MbapRequests, TcpRequest
from fieldtwin.gateway.protocols.modbus.transaction import Transaction
from fieldtwin.gateway.runtime.bridge.cache import ReplyCache
from fieldtwin.gateway.runtime.bridge.policy import ALLOWED, AllowRule, Policy, network, within

PDUS = st.binary(min_size=1, max_size=253)


def in_pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    at = sorted({0, len(data), *(c % (len(data) + 1) for c in cuts)})
    return [data[a:b] for a, b in pairwise(at)]


@given(
    st.lists(st.tuples(st.integers(0, 65535), st.sampled_from([0, 0, 0, 1]), st.integers(0, 255), PDUS), max_size=8),
    st.lists(st.integers(0, 5000), max_size=20),
)
def test_requests_of_a_stream_are_found_wherever_it_is_cut(
    adus: list[tuple[int, int, int, bytes]], cuts: list[int]
) -> None:
    data = b"".join(struct.pack(">HHHB", t, p, len(pdu) + 1, u) + pdu for t, p, u, pdu in adus)
    stream, found = MbapRequests(), list[TcpRequest]()
    for piece in in_pieces(data, cuts):
        found += stream.feed(piece)
    assert found == [TcpRequest(t, u, pdu) for t, p, u, pdu in adus if p == 0]
    assert stream.foreign == sum(p for _, p, _, _ in adus)
    assert not stream.desync


@given(st.lists(st.binary(max_size=400), max_size=20))
def test_a_stream_of_anything_is_bounded_and_ends_in_requests_or_in_desync(pieces: list[bytes]) -> None:
    stream = MbapRequests()
    for piece in pieces:
        for request in stream.feed(piece):
            assert 1 <= len(request.pdu) <= 253
        assert len(stream._buffer) < 260


@given(st.binary(max_size=300))
def test_a_request_is_read_or_refused_with_01_02_or_03(pdu: bytes) -> None:
    try:
        asked = examine(pdu)
    except ModbusExceptionReply as refused:
        code = refused.code
    else:
        code = 0
    assert code in (0, 1, 2, 3)
    if code:
        return
    assert asked.function == pdu[0]
    assert asked.changes or asked.function in READ_FUNCTIONS | {0x08}
    for access in asked.accesses:
        assert 1 <= access.count <= 2000
        assert access.address + access.count <= 0x10000
        assert asked.changes or not access.write


@pytest.mark.parametrize(
    ("case", "pdu", "accesses"),
    [
        ("FC23 writes before it reads (MB-042)", "17 0003 0002 000E 0001 02 00FF", [(14, 1, True), (3, 2, False)]),
        ("FC22", "16 0004 00F2 0025", [(4, 1, True)]),
        ("FC15", "0F 0013 000A 02 CD01", [(19, 10, True)]),
        ("FC24", "18 04DE", [(0x4DE, 1, False)]),
    ],
)
def test_the_addresses_of_a_request(case: str, pdu: str, accesses: list[tuple[int, int, bool]]) -> None:
    table = "coil" if pdu.startswith("0F") else "holding"
    assert list(examine(bytes.fromhex(pdu)).accesses) == [Access(table, *a) for a in accesses], case  # type: ignore[arg-type]


@given(
    st.lists(
        st.tuples(
            st.integers(1, 247),
            st.sampled_from(
                ["03 0000 0001", "06 0001 BEEF", "10 0000 0001 02 1234", "01 0000 0010", "11", "2B 0E 01 00"]
            ),
        ),
        min_size=1,
        max_size=5,
    ),
    st.lists(st.integers(0, 200), max_size=10),
)
def test_frames_on_a_line_are_found_wherever_they_are_cut(frames: list[tuple[int, str]], cuts: list[int]) -> None:
    expected = [LineRequest(unit, bytes.fromhex(pdu)) for unit, pdu in frames]
    line, found = RtuRequests(86_000), list[LineRequest]()
    for piece in in_pieces(b"".join(with_crc(bytes([r.unit]) + r.pdu) for r in expected), cuts):
        found += line.feed(piece)
    assert found == expected
    assert line.noise_bytes == 0


@given(st.binary(max_size=600))
def test_after_any_noise_and_a_silence_the_next_request_is_received(noise: bytes) -> None:
    line = RtuRequests(86_000)
    line.feed(noise)
    line.silence()
    assert not line.pending
    request = LineRequest(5, bytes.fromhex("03 0000 0001"))
    assert line.feed(with_crc(b"\5" + request.pdu)) == [request]


def test_mb_004_half_a_request_then_a_whole_one() -> None:
    line = RtuRequests(86_000)
    assert line.feed(with_crc(bytes.fromhex("05 03 0000 0001"))[:5]) == []
    assert line.pending
    assert line.silence() == []
    assert line.feed(with_crc(bytes.fromhex("05 06 0000 0001"))) == [LineRequest(5, bytes.fromhex("06 0000 0001"))]
    assert line.noise_bytes == 5


def test_mb_050_a_frame_of_256_bytes_and_one_of_257() -> None:
    line = RtuRequests(86_000)
    pdu = bytes([0x64]) + bytes(range(252))
    assert line.feed(with_crc(b"\5" + pdu)) == [LineRequest(5, pdu)]
    assert line.feed(with_crc(b"\5" + pdu + b"\x01")) + line.silence() == []


# -- passed on --------------------------------------------------------------------------------------------------------------


def passed_on(pdu: str, reply: bytes, *, pieces: int = 1, silence: bool = False) -> bytes | None:
    """Return the reply PDU that the client accepts for a forwarded request on RTU, or None while it waits; with `silence`, the
    PDU that it accepts after silence on the line."""
    data = bytes.fromhex(pdu)
    framer = make_framer("rtu", char_time_ns=86_000, echo=False, strict=False, accepts_zero_id=False)
    request = Forwarded(5, data, examine(data), on_line=True)
    transaction = Transaction(framer, 5, request, timeout_ns=10**9, char_time_ns=86_000)
    transaction.start(0)
    size = -(-len(reply) // pieces)
    for at in range(0, len(reply), size):
        answer = transaction.feed(reply[at : at + size], 10**6)
        if answer is not None:
            return answer.raw
    answer = transaction.poll(transaction.wake_ns) if silence else None
    return answer.raw if answer is not None else None


@pytest.mark.parametrize("pieces", [1, 3, 100])
@pytest.mark.parametrize(
    ("pdu", "reply"),
    [
        ("03 0000 0001", "03 02 1234"),
        ("01 0000 0009", "01 02 FF01"),
        ("10 0000 0001 02 1234", "10 0000 0001"),
        ("16 0004 00F2 0025", "16 0004 00F2 0025"),
        ("07", "07 6D"),
        ("0B", "0B FFFF 0108"),
        ("0C", "0C 08 0000 0108 0121 2000"),
        ("11", "11 03 0102FF"),
        ("18 04DE", "18 0006 0002 01B8 1284"),
        ("14 07 06 0004 0001 0002", "14 06 05 06 0DFE 0020"),
        ("15 09 06 0004 0007 0001 06AF", "15 09 06 0004 0007 0001 06AF"),
        ("2B 0E 01 00", "2B 0E 01 01 00 00 01 00 02 4142"),
        ("08 0000 A537", "08 0000 A537"),
    ],
)
def test_replies_of_every_function_end_at_their_length(pdu: str, reply: str, pieces: int) -> None:
    answer = bytes.fromhex(reply)
    assert passed_on(pdu, with_crc(b"\5" + answer), pieces=pieces) == answer


@pytest.mark.parametrize("pieces", [1, 3, 8, 100])
@pytest.mark.parametrize("reply", ["64 0A0B0C0D", "64", "64 5D 00 12 34"])
def test_a_reply_of_unknown_length_ends_with_a_silence(reply: str, pieces: int) -> None:
    answer = bytes.fromhex(reply)
    frame = with_crc(b"\5" + answer)
    assert passed_on("64 01 02", frame, pieces=pieces) is None
    assert passed_on("64 01 02", frame, pieces=pieces, silence=True) == answer


def test_a_reply_that_looks_like_a_shorter_one_followed_by_a_zero_is_passed_on_whole() -> None:
    found = next(
        answer for n in range(0x10000) if (answer := b"\x64" + n.to_bytes(2)) and with_crc(b"\5" + answer)[-1] == 0
    )
    frame = with_crc(b"\5" + found)
    assert crc16(frame[:-1]) == 0  # by its check sum it could have ended here
    for pieces in (1, 2, len(frame)):
        assert passed_on("64 01 02", frame, pieces=pieces, silence=True) == found


def test_an_acknowledgement_of_a_different_request_is_not_an_answer() -> None:
    with pytest.raises(Exception, match="differs from the request"):
        passed_on("06 0001 1234", with_crc(bytes.fromhex("05 06 0001 1235")))


@given(PDUS, st.binary(max_size=260))
def test_lengths_of_replies_are_within_a_frame(pdu: bytes, head: bytes) -> None:
    try:
        asked = examine(pdu)
    except ModbusExceptionReply:
        return
    length = Forwarded(1, pdu, asked, on_line=True).reply_length(bytes([asked.function]) + head)
    assert length <= 260
    assert length >= -1


# -- permissions and cache ------------------------------------------------------------------------------------------------


def test_a_network_contains_addresses_in_each_notation() -> None:
    nets = (network("10.1.0.0/16"), network("fd00::/8"))
    assert within("10.1.200.3", nets)
    assert within("::ffff:10.1.200.3", nets)  # how a dual-stack socket shows an IPv4 client
    assert within("fd00::1%eth0", nets)
    assert not within("10.2.0.1", nets)
    assert not within("nonsense", nets)
    with pytest.raises(UsageError):
        network("10.1.0.5/16")


@given(PDUS)
def test_without_permission_no_request_that_may_change_a_unit_passes(pdu: bytes) -> None:
    try:
        asked = examine(pdu)
    except ModbusExceptionReply:
        return
    everything = AllowRule(functions=frozenset(range(1, 128)))
    assert (Policy((everything,)).check("127.0.0.1", 1, asked) == ALLOWED) == (not asked.changes)
    assert Policy((everything,), allow_writes=True).check("127.0.0.1", 1, asked) == ALLOWED
    if Policy((AllowRule(),), allow_writes=True).check("127.0.0.1", 1, asked) == ALLOWED:
        assert not asked.changes  # a rule for reading passes no write, whatever the permissions


def test_the_cache_keeps_no_reply_beyond_its_age() -> None:
    cache = ReplyCache(age_ms=10)
    cache.put("a", 1, b"\3\0\0\0\1", b"\3\2\0\7", 0)
    assert cache.get("a", 1, b"\3\0\0\0\1", 10_000_000) == b"\3\2\0\7"
    assert cache.get("a", 1, b"\3\0\0\0\1", 10_000_001) is None
    assert cache.get("a", 2, b"\3\0\0\0\1", 0) is None
    for n in range(2000):
        cache.put("a", 1, b"\3" + n.to_bytes(4), b"x", 0)
    assert cache.evicted == 2000 - 1024  # one of them was there already
    cache.forget("a", 0)
    assert cache.get("a", 1, b"\3" + (1999).to_bytes(4), 0) is None
