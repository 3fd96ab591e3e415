"""CAN FD frames on the modelled bus: their bits, and their duration with the bit-rate switch (ISO 11898-1:2015, 10.4.2).

Defect: CAN FD frames were refused.
"""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.emulators.wires.can_bus import CanBus
from fieldtwin.emulators.wires.can_fd_timing import data_phase, fd_bits
from fieldtwin.emulators.wires.can_timing import bits_to_end, wire_bits
from fieldtwin.gateway.core.canframe import FD_LENGTHS, FD_RECORD_SIZE, CanFrame, pack_record, unpack_record
from fieldtwin.gateway.core.errors import Desync, UsageError

FRAMES = st.builds(
    lambda can_id, length, extended, brs, esi, random: CanFrame(
        can_id if extended else can_id & 0x7FF, random.randbytes(length), extended=extended, fd=True, brs=brs, esi=esi
    ),
    st.integers(0, 0x1FFFFFFF),
    st.sampled_from(sorted(FD_LENGTHS)),
    st.booleans(),
    st.booleans(),
    st.booleans(),
    st.randoms(use_true_random=False),
)
ALTERNATING = CanFrame(0x2AA, b"\x55" * 64, fd=True, brs=True)
"""A frame without a dynamic stuff bit: its parts can be counted by hand."""


def unstuffed(bits: str) -> tuple[str, int]:
    """Remove the bit after each run of five, as a receiver does; return the bits, and the number of removed ones."""
    out, run, at, taken = "", 0, 0, 0
    while at < len(bits):
        run = run + 1 if at and bits[at] == bits[at - 1] else 1
        out += bits[at]
        at += 1
        if run == 5 and at < len(bits):
            assert bits[at] != bits[at - 1]
            run, at, taken = 1, at + 1, taken + 1
            if at < len(bits):
                run = 2 if bits[at] == bits[at - 1] else 1
                out += bits[at]
                at += 1
    return out, taken


def remainder(bits: str, polynomial: int, length: int) -> int:
    """Divide with the checksum's register preset to its highest bit, on integers."""
    value = int(bits, 2) ^ (1 << len(bits) - 1)
    while value.bit_length() > length:
        value ^= polynomial << value.bit_length() - length - 1
    return value


def test_a_frame_without_stuff_bits_counted_by_hand() -> None:
    # SOF 1, identifier 11, RRS, IDE, FDF, res, BRS; ESI, DLC 4, data 512, stuff count and CRC 25 with 7 fixed stuff bits, CRC
    # delimiter; acknowledge slot and delimiter, end of frame 7.
    assert data_phase(ALTERNATING) == (17, 17 + 1 + 4 + 512 + 32 + 1)
    assert bits_to_end(ALTERNATING) == len(wire_bits(ALTERNATING)) == 576


@pytest.mark.parametrize(("data_bitrate", "took_ns"), [(2_000_000, 327_000), (500_000, 1_152_000), (0, 1_152_000)])
def test_the_data_phase_takes_its_time_at_the_data_bit_rate(data_bitrate: int, took_ns: int) -> None:
    bus = CanBus(500_000, data_bitrate=data_bitrate)
    node, other = bus.join(0), bus.join(0)
    bus.submit(node, ALTERNATING, 0)
    bus.submit(node, ALTERNATING, 0)
    first, second = bus.advance(10_000_000)
    assert first.frame.t_ns == took_ns
    assert second.start_ns == took_ns + 3 * 2_000  # the interframe space is at the nominal bit rate
    assert first.receivers == (other,)


def test_a_frame_without_the_switch_is_sent_at_the_nominal_bit_rate() -> None:
    bus = CanBus(500_000, data_bitrate=2_000_000)
    frame = CanFrame(0x2AA, b"\x55" * 64, fd=True)
    bus.submit(bus.join(0), frame, 0)
    (delivery,) = bus.advance(10_000_000)
    assert delivery.frame.t_ns == bits_to_end(frame) * 2_000


@given(FRAMES)
def test_a_receiver_finds_the_check_sum_and_the_stuff_count_right(frame: CanFrame) -> None:
    length, polynomial = (17, 0x3685B) if len(frame.data) <= 16 else (21, 0x302899)
    bits, field = fd_bits(frame), 4 + length
    fixed = -(-field // 4)
    stuffed, tail = bits[: -field - fixed], bits[-field - fixed :]
    assert re.fullmatch("(?:[01]{5})*[01]{0,5}", tail)
    groups = [tail[at : at + 5] for at in range(0, len(tail), 5)]
    for before, group in zip([stuffed, *groups], groups, strict=False):
        assert group[0] != before[-1], "a fixed stuff bit is the complement of the bit before it"
    plain = "".join(group[1:] for group in groups)
    assert remainder(stuffed + plain, polynomial, length) == 0
    covered, taken = unstuffed(stuffed)
    assert len(covered) == (37 if frame.extended else 18) + 4 + 8 * len(frame.data)
    gray = int(plain[:3], 2)
    assert gray ^ gray >> 1 ^ gray >> 2 == taken % 8
    assert plain[:4].count("1") % 2 == 0


@given(FRAMES)
def test_a_frame_survives_its_record(frame: CanFrame) -> None:
    record = pack_record(frame, fd=True)
    assert len(record) == FD_RECORD_SIZE
    assert unpack_record(record) == (frame, False)
    with pytest.raises(UsageError):
        pack_record(frame)


@pytest.mark.parametrize("length", [9, 13, 63, 65])
def test_a_length_that_can_fd_does_not_have_is_refused(length: int) -> None:
    with pytest.raises(Desync, match="12, 16, 20"):
        CanFrame(0x123, bytes(length), fd=True)


def test_the_bits_of_can_fd_need_can_fd() -> None:
    for wrong in ({"brs": True}, {"esi": True}, {"fd": True, "remote": True}):
        with pytest.raises(Desync):
            CanFrame(0x123, **wrong)
    assert str(ALTERNATING).startswith("2AA##15555")
