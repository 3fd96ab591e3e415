"""Frame lengths and arbitration keys, against vectors computed by hand and an oracle with a different method."""

from __future__ import annotations

import re

from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.emulators.wires.can_timing import arbitration_key, bits_on_wire, bits_to_end, crc15, plain_bits, stuff
from fieldtwin.gateway.core.canframe import CanFrame


@st.composite
def frames(draw: st.DrawFn) -> CanFrame:
    extended, remote = draw(st.booleans()), draw(st.booleans())
    can_id = draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF))
    # Bytes of few kinds, because stuffing depends on long runs.
    data = draw(st.lists(st.sampled_from([0x00, 0xFF, 0x0F, 0xF8, 0x55]) | st.integers(0, 255), max_size=8))
    if remote:
        return CanFrame(can_id, extended=extended, remote=True, dlc=len(data))
    return CanFrame(can_id, bytes(data), extended=extended)


def test_identifier_0_without_data() -> None:
    # SOF, 11 identifier bits, RTR, IDE, r0 and 4 DLC bits are all dominant, so the CRC is 0: 34 zeros in a row.
    # A stuff bit after every 5 of them: 6 (the last 4 zeros get none). 34 + 6 + 10 to the end of frame + 3 = 53.
    frame = CanFrame(0x000)
    assert plain_bits(frame) == "0" * 34
    assert stuff(plain_bits(frame)) == "000001" * 6 + "0000"
    assert bits_to_end(frame) == 50
    assert bits_on_wire(frame) == 53


def test_identifier_1_without_data() -> None:
    # The single 1 is followed by 7 bits, so the CRC is x^7 * x^15 = x^22 modulo x^15 + 4599h, by seven shifts from
    # x^15 = 4599h: 4EAB 58CF 7407 2D97 5B2E 73C5 2213h.
    frame = CanFrame(0x001)
    assert plain_bits(frame) == "0" + "00000000001" + "000" + "0000" + f"{0x2213:015b}"
    # 11 zeros take 2 stuff bits, then a 1, then 7 zeros and the CRC's first make 8: one more. 34 + 3 + 13 = 50.
    assert stuff(plain_bits(frame)).startswith("000001" * 2 + "01" + "000001" + "0001")
    assert bits_to_end(frame) == 47
    assert bits_on_wire(frame) == 50


def test_a_stuff_bit_starts_a_new_run() -> None:
    # Five ones, the 0 that is stuffed in, and four zeros make another run of five zeros: stuffed again, and so on.
    assert stuff("11111" + "0000" + "1111" + "00") == "111110" + "00001" + "11110" + "00"


def _oracle_length(frame: CanFrame) -> int:
    """Compute the same by other means: polynomial division of big integers, and stuffing by a regular expression."""
    rtr = str(int(frame.remote))
    if frame.extended:
        text = f"{frame.can_id:029b}"
        covered = "0" + text[:11] + "1" + "1" + text[11:] + rtr + "0" + "0"
    else:
        covered = "0" + f"{frame.can_id:011b}" + rtr + "0" + "0"
    covered += f"{frame.dlc:04b}" + (f"{int.from_bytes(frame.data):0{8 * len(frame.data)}b}" if frame.data else "")
    remainder = int(covered, 2) << 15
    for shift in range(len(covered) - 1, -1, -1):
        if remainder >> (shift + 15) & 1:
            remainder ^= 0b1100010110011001 << shift
    assert crc15(covered) == remainder
    left, out = covered + f"{remainder:015b}", ""
    while match := re.search("00000|11111", left):
        out += left[: match.end()]
        # The stuffed bit goes in front of what is left and is looked at again there.
        left = ("1" if match.group()[0] == "0" else "0") + left[match.end() :]
    return len(out + left) + 13


@given(frames())
def test_length_equals_the_oracle_and_keeps_the_bounds(frame: CanFrame) -> None:
    n = len(frame.data)
    low, high = (67 + 8 * n, 80 + 10 * n) if frame.extended else (47 + 8 * n, 55 + 10 * n)
    assert low <= bits_on_wire(frame) <= high
    assert bits_on_wire(frame) == _oracle_length(frame)


@given(frames())
def test_crc_over_frame_and_crc_is_zero(frame: CanFrame) -> None:
    assert crc15(plain_bits(frame)) == 0


def test_no_run_of_six_on_the_wire() -> None:
    for data in (b"\0" * 8, b"\xff" * 8, b"\x0f" * 8, b"\xf8" * 8):
        assert not re.search("0{6}|1{6}", stuff(plain_bits(CanFrame(0x7F, data))))


def test_the_frame_with_the_lower_arbitration_field_wins() -> None:
    in_order = [
        CanFrame(0x001, b"\xff"),
        CanFrame(0x002),
        CanFrame(0x100, b"x"),
        CanFrame(0x100, remote=True, dlc=1),  # data before remote
        CanFrame(0x100 << 18, extended=True),  # 11 bit before 29 bit of the same base
        CanFrame(0x100 << 18, extended=True, remote=True),
        CanFrame((0x100 << 18) + 1, extended=True),
        CanFrame((0x101 << 18), extended=True),
        CanFrame(0x102),
        CanFrame(0x7FF, remote=True),
        CanFrame(0x1FFFFFFF, extended=True, remote=True),
    ]
    keys = [arbitration_key(frame) for frame in in_order]
    assert keys == sorted(keys)
    assert len(set(keys)) == len(keys)


@given(frames(), frames())
def test_the_key_orders_as_the_arbitration_fields_do(a: CanFrame, b: CanFrame) -> None:
    # Bit by bit to RTR (11 bit: and IDE, which is dominant; 29 bit: the 32 bits to RTR), dominant 0 wins.
    def field(frame: CanFrame) -> str:
        return plain_bits(frame)[1 : 33 if frame.extended else 14].ljust(32, "0")

    assert (field(a) < field(b)) == (arbitration_key(a) < arbitration_key(b))


@given(frames())
def test_lengths_by_tables_are_those_of_the_bits(frame: CanFrame) -> None:
    assert bits_to_end(frame) == len(stuff(plain_bits(frame))) + 10
