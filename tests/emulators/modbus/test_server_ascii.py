"""ASCII lines and strictly timed RTU lines, character by character (rows 5, 7 and 70 of the list of edge cases)."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.emulators.modbus.ascii import MAX_CHARACTERS, AsciiReceiver, AsciiServer
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.endpoint import SerialSettings


def framed(text: str) -> bytes:
    """Return `text` (hex) as an ASCII frame: the LRC makes the sum of all bytes a multiple of 256."""
    data = bytes.fromhex(text)
    return f":{data.hex()}{-sum(data) & 0xFF:02x}\r\n".upper().encode()


READ, READ_REPLY = framed("01 03 0000 0002"), framed("01 03 04 00AA 00BB")


def make_units(*unit_ids: int) -> dict[int, ModbusUnit]:
    units = {}
    for unit_id in unit_ids or (1,):
        bank = MapBank([CellSpan("holding", 0, 126)])
        bank.poke("holding", 0, 0xAA, 0xBB)
        units[unit_id] = ModbusUnit(bank)
    return units


def test_a_frame_of_the_standard_s_kind() -> None:
    assert READ == b":010300000002FA\r\n"
    server = AsciiServer(make_units())
    (exchange,) = server.receive(READ, 0)
    assert (exchange.heard, exchange.reply) == (READ, READ_REPLY)


def test_the_delimiter_can_be_changed() -> None:
    server = AsciiServer(make_units())
    change = framed("01 08 0003 3B00")
    assert server.feed(change, 0) == [change], "answered as it was asked"
    assert server.feed(READ[:-1] + b";", 1) == [READ_REPLY[:-1] + b";"]
    assert server.feed(READ, 2) == [], "LF ends nothing any more"
    assert server.feed(READ[:-1] + b";", 3) == [READ_REPLY[:-1] + b";"]


def test_every_unit_of_a_line_counts_damaged_frames() -> None:
    server = AsciiServer(make_units(1, 2))
    server.feed(READ[:-4] + b"00\r\n" + READ, 0)
    assert [u.counters.bus_errors for u in server.units.values()] == [1, 1]
    assert [u.counters.bus_messages for u in server.units.values()] == [1, 2], "a reply is its neighbour's message"
    assert (server.counters.frames, server.counters.crc_errors, server.counters.noise_bytes) == (1, 1, 17)


CHUNKS = st.lists(
    st.tuples(
        st.one_of(st.binary(max_size=40), st.sampled_from([READ, READ[:7], b":", b"\r\n", b":0103", b"0" * 300])),
        st.integers(0, 2 * NS_PER_S),
    ),
    max_size=12,
)


@given(CHUNKS)
def test_garbage_never_raises_and_a_frame_after_it_is_answered(chunks: list[tuple[bytes, int]]) -> None:
    server = AsciiServer(make_units())
    now_ns = 0
    for data, wait_ns in chunks:
        server.feed(data, now_ns)
        assert server.pending < MAX_CHARACTERS
        now_ns += wait_ns
    server.feed(b"\r\n", now_ns)
    assert server.feed(READ, now_ns) == [READ_REPLY], "a colon begins a frame, whatever was before"


@given(CHUNKS, st.integers(1, 50))
def test_the_cut_does_not_matter_and_every_character_is_accounted_for(
    chunks: list[tuple[bytes, int]], step: int
) -> None:
    whole, cut = AsciiReceiver(), AsciiReceiver()
    now_ns, fed = 0, 0
    for data, wait_ns in chunks:
        frames = whole.feed(data, now_ns)
        assert [f for i in range(0, len(data) or 1, step) for f in cut.feed(data[i : i + step], now_ns)] == frames
        fed += len(data)
        now_ns += wait_ns
    assert (whole.frames, whole.crc_errors) == (cut.frames, cut.crc_errors)
    assert whole.noise_bytes == cut.noise_bytes
    if not whole.frames:
        assert whole.noise_bytes + whole.pending == fed


# -- strict timing ------------------------------------------------------------------------------------------------

LINE = SerialSettings(9600, "8E1")
CHAR_NS = 1_145_834  # 11 bits, rounded up
RTU_READ = bytes.fromhex("01 03 0000 0002 C40B")


class StrictLine:
    def __init__(self) -> None:
        self.server = RtuServer(make_units(), strict=LINE)
        self.now_ns = 0
        self.replies: list[bytes] = []

    def chars(self, data: bytes) -> StrictLine:
        for i in range(len(data)):
            self.now_ns += CHAR_NS
            self.replies += self.server.feed(data[i : i + 1], self.now_ns)
        return self

    def pause(self, chars: float) -> StrictLine:
        self.now_ns += round(chars * CHAR_NS)
        self.replies += self.server.feed(b"", self.now_ns)
        return self


def test_mb_005_strict_a_pause_over_t1_5_spoils_the_frame() -> None:
    assert len(StrictLine().chars(RTU_READ).pause(3.6).replies) == 1
    assert len(StrictLine().chars(RTU_READ[:4]).pause(1.4).chars(RTU_READ[4:]).pause(3.6).replies) == 1
    line = StrictLine().chars(RTU_READ[:4]).pause(1.6).chars(RTU_READ[4:]).pause(3.6)
    assert line.replies == []
    assert line.server.counters.crc_errors == 1
    assert len(line.chars(RTU_READ).pause(3.6).replies) == 1


def test_mb_007_strict_two_frames_need_t3_5_between_them() -> None:
    line = StrictLine().chars(RTU_READ + RTU_READ).pause(4)
    assert (line.replies, line.server.counters.noise_bytes) == ([], 16)
    assert len(line.chars(RTU_READ).pause(3.6).chars(RTU_READ).pause(3.6).replies) == 2
    assert len(line.chars(RTU_READ).replies) == 2, "not before the pause"


@pytest.mark.parametrize("length", [3, 257, 100_000])
def test_strict_frames_of_a_wrong_length(length: int) -> None:
    line = StrictLine()
    line.now_ns += length * CHAR_NS
    assert line.server.feed(bytes(length), line.now_ns) == []
    assert line.server.pending == length
    line.pause(4)
    assert line.server.counters.noise_bytes == length
    assert len(line.chars(RTU_READ).pause(3.6).replies) == 1
