"""Extracting replies from arbitrary received bytes loses nothing and invents nothing."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.conformance.devices.modbus.frames import ReceivedReply, framed, mbap, replies

FRAMINGS = ("rtu", "ascii", "mbap")
units = st.integers(0, 255)
pdus = st.one_of(
    st.builds(lambda n: bytes((0x03, 2 * n)) + bytes(range(2 * n)), st.integers(1, 100)),
    st.builds(lambda function, code: bytes((function | 0x80, code)), st.integers(1, 0x7F), st.integers(1, 11)),
)


@pytest.mark.parametrize("framing", FRAMINGS)
@given(said=st.lists(st.tuples(units, pdus), max_size=4))
@settings(max_examples=40, deadline=None)
def test_consecutive_frames_are_all_found(framing: str, said: list[tuple[int, bytes]]) -> None:
    data = b"".join(framed(framing, unit, pdu, n) for n, (unit, pdu) in enumerate(said))
    answers, rest = replies(framing, data)
    assert [(a.unit, a.pdu) for a in answers] == said
    assert rest == b""


@pytest.mark.parametrize("framing", FRAMINGS)
@given(data=st.binary(max_size=400))
@settings(max_examples=60, deadline=None)
def test_garbage_contains_no_replies(framing: str, data: bytes) -> None:
    answers, rest = replies(framing, data)
    again = sum(len(framed(framing, a.unit, a.pdu)) for a in answers)
    assert again + len(rest) == len(data)


@given(noise=st.binary(min_size=1, max_size=3).filter(lambda b: 0x3A not in b), unit=st.integers(1, 247), pdu=pdus)
@settings(max_examples=40, deadline=None)
def test_noise_before_an_ascii_frame_is_rest(noise: bytes, unit: int, pdu: bytes) -> None:
    assert replies("ascii", noise + framed("ascii", unit, pdu)) == ([ReceivedReply(unit, pdu)], noise)


def test_an_exception_is_five_bytes_although_its_first_four_fit() -> None:
    assert replies("rtu", bytes.fromhex("01 80 01 80 00")) == ([ReceivedReply(1, b"\x80\x01")], b"")
    assert replies("rtu", bytes.fromhex("01 80 01 80"))[0] == []


def test_wrong_headers_are_not_frames() -> None:
    body = b"\x01\x03\x02\x00\xaa"
    for adu in (mbap(body, 7, protocol=1), mbap(body, 7, length=0), mbap(body, 7, length=0xFFFF)):
        assert replies("mbap", adu) == ([], adu)


def test_a_babble_takes_no_time() -> None:
    answers, rest = replies("rtu", bytes(range(1, 251)) * 32)
    assert len(rest) + sum(len(a.pdu) + 3 for a in answers) == 8000
