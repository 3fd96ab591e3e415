"""The emulated line, byte by byte: rows of the list of edge cases about RTU framing and several units."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.rtu.receiver import RtuReceiver
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.errors import UsageError

PAUSE_NS = 100 * NS_PER_MS
BYTE_NS = 572_917  # 11 bits at 19200 baud


def crc(frame: str) -> bytes:
    """The checksum by its definition, bit by bit (SL 2.5.1.2), and not by the table under test."""
    value = 0xFFFF
    data = bytes.fromhex(frame)
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return data + value.to_bytes(2, "little")


READ = crc("01 03 0000 0002")
READ_REPLY = crc("01 03 04 00AA 00BB")


def make_server(*unit_ids: int) -> RtuServer:
    units = {}
    for unit_id in unit_ids or (1,):
        bank = MapBank([CellSpan("holding", 0, 300), CellSpan("coil", 0, 64)])
        bank.poke("holding", 0, 0xAA, 0xBB)
        units[unit_id] = ModbusUnit(bank)
    return RtuServer(units)


class Line:
    """Feed a server as a line would: time passes with every byte."""

    def __init__(self, server: RtuServer) -> None:
        self.server = server
        self.now_ns = 1
        self.replies: list[bytes] = []

    def whole(self, data: bytes) -> Line:
        self.now_ns += len(data) * BYTE_NS
        self.replies += self.server.feed(data, self.now_ns)
        return self

    def bytewise(self, data: bytes) -> Line:
        for i in range(len(data)):
            self.whole(data[i : i + 1])
        return self

    def pause(self, ns: int = PAUSE_NS) -> Line:
        self.now_ns += ns
        self.replies += self.server.feed(b"", self.now_ns)
        return self


def test_checksums_from_other_sources() -> None:
    """Frames from other sources: the two examples in every Modbus manual."""
    assert crc("01 03 0000 000A") == bytes.fromhex("01 03 0000 000A C5CD")
    assert crc("11 03 006B 0003") == bytes.fromhex("11 03 006B 0003 7687")
    for frame in ("01 03 0000 000A C5CD", "11 03 006B 0003 7687"):
        data = bytes.fromhex(frame)
        assert RtuReceiver(frozenset({1})).feed(data, 0) == [data]


# Bytes on the line, and the required answers, by row.
ROWS = [
    pytest.param(READ, [READ_REPLY], id="a request"),
    pytest.param(READ[:-1] + b"\x00", [], id="MB-001 bad CRC"),
    pytest.param(READ[:-1] + b"\x00" + READ, [READ_REPLY], id="MB-001 bad CRC, then a good frame"),
    pytest.param(b"\x00" + READ, [READ_REPLY], id="MB-008 leading 00"),
    pytest.param(b"\xff" + READ, [READ_REPLY], id="MB-008 leading FF"),
    pytest.param(b"\x00\x00\x00" + READ, [READ_REPLY], id="MB-008 leading 00 00 00"),
    pytest.param(b"\xff\xff\xff\xff" + READ, [READ_REPLY], id="MB-008 leading FF FF FF FF"),
    pytest.param(READ + b"\x00\x00" + READ, [READ_REPLY] * 2, id="MB-009 trailing 00s"),
    pytest.param(READ + READ, [READ_REPLY] * 2, id="MB-007 no gap"),
    pytest.param(crc("00 06 0005 0009") + READ, [READ_REPLY], id="MB-026 broadcast write"),
    pytest.param(crc("00 03 0000 0002") + READ, [READ_REPLY], id="MB-027 broadcast read"),
    pytest.param(crc("05 03 0000 0002"), [], id="MB-029 another unit"),
    pytest.param(crc("05 03 0000 0002") + crc("05 03 04 01020304") + READ, [READ_REPLY], id="MB-030 its response too"),
    pytest.param(crc("05 03 0000 0002") + crc("05 83 02") + READ, [READ_REPLY], id="MB-030 its exception"),
    pytest.param(
        crc("05 10 0000 0002 04 00000001") + crc("05 10 0000 0002") + READ, [READ_REPLY], id="MB-030 its write"
    ),
    pytest.param(crc("05 18 0000") + crc("05 18 0006 0002 0001 0002") + READ, [READ_REPLY], id="MB-044 its FIFO"),
    pytest.param(crc("05 17 0000 0001 0000 0001 02 0007") + crc("05 17 02 0007") + READ, [READ_REPLY], id="MB-030 17h"),
    pytest.param(
        # an RTU request to us inside the payload of another unit's write is its data, not a request
        crc("05 10 0000 0004 08" + READ.hex()) + READ,
        [READ_REPLY],
        id="MB-030 a frame for us inside its data",
    ),
    pytest.param(crc("05 03 0000 0002") + READ, [READ_REPLY], id="MB-031 it is silent"),
    pytest.param(crc("05 64 010203"), [], id="MB-032 unknown function to another unit"),
    pytest.param(crc("05 64 010203") + READ, [READ_REPLY], id="MB-032 then ours"),
    pytest.param(crc("01 64 010203"), [crc("01 E4 01")], id="MB-033 unknown function"),
    pytest.param(crc("01 41"), [crc("01 C1 01")], id="MB-033 unknown function of two bytes"),
    pytest.param(crc("01 64 010203") + READ, [crc("01 E4 01"), READ_REPLY], id="MB-034 then a valid frame"),
    pytest.param(crc("01 2B 0E 01 00") + READ, [crc("01 AB 01"), READ_REPLY], id="MB-034 unsupported 2Bh"),
    pytest.param(crc("01 83 02") + READ, [READ_REPLY], id="MB-035 function from 80h"),
    pytest.param(crc("01 10 0000 0002 03 000102"), [crc("01 90 03")], id="MB-040 byte count mismatch"),
    pytest.param(crc("01 08 0000" + "5A" * 250), [crc("01 08 0000" + "5A" * 250)], id="MB-050 256 bytes"),
    pytest.param(crc("01 08 0000" + "5A" * 251), [], id="MB-050 257 bytes"),
    pytest.param(crc("01 08 0000" + "5A" * 251) + READ, [READ_REPLY], id="MB-050 257 bytes, then a request"),
    pytest.param(crc("01 10 0002 007B F6" + "0001" * 123), [crc("01 10 0002 007B")], id="MB-050 the longest write"),
]


@pytest.mark.parametrize(("heard", "expected"), ROWS)
@pytest.mark.parametrize("way", ["whole", "bytewise"])
def test_bytes_on_a_line_give_the_expected_replies(heard: bytes, expected: list[bytes], way: str) -> None:
    line = Line(make_server())
    getattr(line, way)(heard)
    assert line.replies == expected
    line.pause().whole(READ)
    assert line.replies == [*expected, READ_REPLY], "the line was wedged"


@pytest.mark.parametrize(("heard", "expected"), ROWS)
@pytest.mark.parametrize("before", ["A5", "05 03 20 11", "01 10 0000 0064 C8 00", "010300"])
def test_line_after_garbage_and_a_pause(heard: bytes, expected: list[bytes], before: str) -> None:
    line = Line(make_server()).whole(bytes.fromhex(before)).pause().whole(heard)
    assert line.replies == expected


def test_mb_001_is_counted_on_the_line_and_by_every_unit() -> None:
    server = make_server(1, 2)
    line = Line(server).whole(READ[:-1] + b"\x00").pause()
    assert (server.counters.crc_errors, server.counters.noise_bytes, server.counters.frames) == (1, 8, 0)
    line.whole(READ).pause()
    assert [u.counters.bus_errors for u in server.units.values()] == [1, 1]
    assert server.counters.crc_errors == 1
    assert server.units[1].counters.requests == 1


@pytest.mark.parametrize("cut", range(1, 17))
def test_mb_004_half_a_request_a_pause_a_full_request(cut: int) -> None:
    long_request = crc("01 10 0000 0004 08 0001 0002 0003 0004")
    server = make_server()
    line = Line(server).whole(long_request[:cut])
    line.now_ns += PAUSE_NS  # the pause is only detected with the next byte
    line.whole(READ)
    assert line.replies == [READ_REPLY]
    assert server.units[1].bank.read("holding", 0, 1, 0) == [0xAA]


def test_mb_004_a_pause_too_short_to_be_seen_costs_no_more_than_the_gap() -> None:
    """Half a long request and a complete one without a pause: answered after the line pauses."""
    line = Line(make_server()).whole(crc("01 10 0000 0064 C8" + "00" * 200)[:40]).whole(READ)
    assert line.replies == []
    assert line.pause().replies == [READ_REPLY]


def test_a_frame_with_a_pause_longer_than_the_gap_is_dropped() -> None:
    line = Line(make_server()).whole(READ[:4]).pause().whole(READ[4:]).pause()
    assert line.replies == []
    assert line.server.counters.noise_bytes == 8


def test_mb_006_a_frame_that_pauses_16_ms_is_one() -> None:
    assert Line(make_server()).whole(READ[:4]).pause(16 * NS_PER_MS).whole(READ[4:]).replies == [READ_REPLY]


def test_mb_026_all_execute_and_none_answers() -> None:
    server = make_server(1, 2, 247)
    line = Line(server).whole(crc("00 10 0005 0001 02 0009"))
    assert line.replies == []
    assert [u.bank.read("holding", 5, 1, 0) for u in server.units.values()] == [[9]] * 3
    assert [u.counters.broadcasts for u in server.units.values()] == [1] * 3


def test_units_answer_for_themselves() -> None:
    server = make_server(1, 7)
    server.units[7].bank.write("holding", 0, [0x77], 0)
    line = Line(server).whole(crc("07 03 0000 0001") + READ)
    assert line.replies == [crc("07 03 02 0077"), READ_REPLY]


def test_mb_047_counters_are_true_to_the_wire() -> None:
    server = make_server(1, 2)
    line = Line(server)
    for data in (READ, crc("05 03 0000 0001"), crc("05 03 02 0000"), READ[:-1] + b"\x00", crc("00 06 0001 0001")):
        line.whole(data).pause()
    line.replies.clear()
    # received by 2 so far: a request to 1 and its reply, a request to 5 and its reply, a broadcast; now this one
    assert line.whole(crc("02 08 000B 0000")).replies == [crc("02 08 000B 0006")]
    assert line.whole(crc("02 08 000C 0000")).replies[1:] == [crc("02 08 000C 0001")]
    assert line.whole(crc("02 08 000F 0000")).replies[2:] == [crc("02 08 000F 0001")]
    one = server.units[1].counters
    assert (one.requests, one.replies, one.broadcasts) == (1, 1, 1)
    # four messages before that were not its own reply, three requests to 2 and their replies, and this one
    assert line.whole(crc("01 08 000B 0000")).replies[3:] == [crc("01 08 000B 000B")]


def test_mb_008_a_stray_byte_is_noise_and_no_damaged_frame() -> None:
    server = make_server()
    Line(server).whole(b"\x00" + READ).pause().whole(b"\xff\xff\xff").pause().whole(READ)
    assert (server.counters.crc_errors, server.counters.noise_bytes, server.counters.frames) == (0, 4, 2)


def test_mb_032_a_frame_of_unknown_length_between_others_is_not_noise() -> None:
    server = make_server()
    Line(server).bytewise(crc("05 64 010203") + READ)
    assert (server.counters.noise_bytes, server.counters.frames) == (0, 2)


def test_unit_ids_of_a_line() -> None:
    for unit_id in (0, 248, -1):
        with pytest.raises(UsageError, match="1 to 247"):
            make_server(unit_id)


CHUNKS = st.lists(st.tuples(st.binary(max_size=40), st.integers(0, 80 * NS_PER_MS)), max_size=12)


@given(CHUNKS)
@example([(bytes.fromhex("01 10 0000 0064 C8"), 0)])
@example([(b"\x01\x17" * 20, 49 * NS_PER_MS)])
def test_garbage_never_raises_and_a_frame_after_a_pause_is_answered(chunks: list[tuple[bytes, int]]) -> None:
    line = Line(make_server(1, 16))
    for data, wait_ns in chunks:
        line.whole(data)
        line.now_ns += wait_ns
        assert line.server.pending <= 256
    line.now_ns += PAUSE_NS
    assert READ_REPLY in line.whole(READ).replies


@given(CHUNKS, st.integers(1, 300))
def test_every_byte_is_accounted_for(chunks: list[tuple[bytes, int]], step: int) -> None:
    receiver = RtuReceiver(frozenset({1}))
    now_ns, fed, framed = 0, 0, 0
    for data, wait_ns in chunks:
        for i in range(0, len(data), step):
            framed += sum(map(len, receiver.feed(data[i : i + step], now_ns)))
        fed += len(data)
        now_ns += wait_ns
    assert framed + receiver.noise_bytes + receiver.pending == fed


@given(
    st.lists(
        st.sampled_from([READ, crc("05 03 0000 0002"), crc("05 04 02 0001"), crc("01 41"), crc("00 05 0001 FF00")]),
        max_size=8,
    ),
    st.data(),
)
def test_the_cut_does_not_matter(frames: list[bytes], data: st.DataObject) -> None:
    """The frames are the same for any division into chunks."""
    stream = b"".join(frames)
    receiver = RtuReceiver(frozenset({1}))
    found: list[bytes] = []
    at = 0
    while at < len(stream):
        size = data.draw(st.integers(1, 20))
        found += receiver.feed(stream[at : at + size], 0)
        at += size
    assert found == frames
    assert receiver.noise_bytes == 0


PIECES = st.one_of(
    st.sampled_from(
        [READ, READ[:5], READ[3:], crc("05 03 0000 0002"), crc("05 10 0000 0004 08" + READ.hex()), crc("01 64 010203")]
    ),
    st.sampled_from([crc("01 08 0000 1234 5678"), crc("00 06 0001 0001"), crc("01 2B 0E 01 00"), b"\x00", b"\xff"]),
    st.binary(max_size=30),
)


@given(st.lists(PIECES, max_size=12), st.integers(1, 40))
def test_the_cut_does_not_matter_in_noise_either(pieces: list[bytes], step: int) -> None:
    """The frames found in garbage, and the bytes counted as such, are the same in one piece and in many."""
    data = b"".join(pieces)
    whole, cut = RtuReceiver(frozenset({1, 16})), RtuReceiver(frozenset({1, 16}))
    frames = whole.feed(data, 0) + whole.feed(b"", PAUSE_NS)
    found = [frame for i in range(0, len(data), step) for frame in cut.feed(data[i : i + step], 0)]
    assert found + cut.feed(b"", PAUSE_NS) == frames
    assert (whole.frames, whole.crc_errors, whole.noise_bytes) == (cut.frames, cut.crc_errors, cut.noise_bytes)
