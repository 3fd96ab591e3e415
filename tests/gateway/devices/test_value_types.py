"""Value types of device profiles, each against bytes computed by hand: register contents, and displayed values."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.errors import FileInvalid, NotAllowed
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.core.files.profile_file import resolve
from fieldtwin.gateway.core.files.yaml_file import parse
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.gateway.devices.codec import apply_scale, decode, encode


def tag(form: str) -> Tag:
    """The tag `t` of a profile with the line `form`."""
    head = 'device: test/types\nsource: "a test"\nprotocol: modbus\ntags:\n  sf: {at: 40002, type: int16}\n'
    text = f"{head}  t: {{at: 40010, {form}}}\n"
    return resolve(parse(text, "types.yaml")).tags["t"]


@pytest.mark.parametrize(
    ("form", "raw", "value"),
    [
        ("type: int16", "fffe", -2),
        ("type: uint16, scale: 0.1", "00eb", 23.5),
        ("type: uint16, scale: 0.5, offset: -40", "0064", 10.0),
        ("type: uint32", "00010002", 0x10002),
        ("type: uint32, order: CDAB", "00020001", 0x10002),
        ("type: uint32, order: BADC", "01000200", 0x10002),
        ("type: uint32, order: DCBA", "02000100", 0x10002),
        ("type: int64", "fffffffffffffffe", -2),
        ("type: float32", "41200000", 10.0),
        ("type: float32, order: CDAB", "00004120", 10.0),
        ("type: bcd16", "1234", 1234),
        ("type: bcd32, scale: 0.01", "00123456", 1234.56),
        ("type: bcd32, order: CDAB", "56780012", 125678),
        ("type: uint16, bits: [4, 7]", "12a4", 0xA),
        ("type: uint16, bits: [15, 15]", "8000", 1),
        ("type: string, registers: 2", "41420000", "AB"),
    ],
)
def test_raw_and_value(form: str, raw: str, value: object) -> None:
    got = decode(tag(form), bytes.fromhex(raw), 7)
    assert got.value == pytest.approx(value) if isinstance(value, float) else got.value == value
    assert (got.quality, got.t_ns, got.raw.hex()) == (Quality.GOOD, 7, raw)


@pytest.mark.parametrize(
    ("form", "raw", "quality", "reason"),
    [
        ("type: int16, sentinels: [0x8000]", "8000", Quality.BAD, Reason.SENTINEL),
        ("type: float32", "7fc00000", Quality.BAD, Reason.NOT_A_NUMBER),
        ("type: float32", "7f800000", Quality.BAD, Reason.NOT_A_NUMBER),
        ("type: bcd16", "12a4", Quality.BAD, Reason.NOT_A_NUMBER),
        ("type: int16, range: [0, 100]", "0065", Quality.UNCERTAIN, Reason.OUT_OF_RANGE),
    ],
)
def test_invalid_register_contents_give_a_bad_or_uncertain_value(
    form: str, raw: str, quality: Quality, reason: Reason
) -> None:
    got = decode(tag(form), bytes.fromhex(raw), 7)
    assert (got.quality, got.reason) == (quality, reason)
    assert quality is not Quality.BAD or got.value is None


def test_a_scale_factor_register_scales_and_its_absence_is_bad() -> None:
    t = tag("type: int16, scale_by: sf")
    value = decode(t, bytes.fromhex("04d2"), 7)
    good = TagValue(-2, Quality.GOOD, Reason.NONE, 7)
    assert apply_scale(t, value, good).value == pytest.approx(12.34)
    assert apply_scale(t, value, None).quality is Quality.BAD
    assert apply_scale(t, value, TagValue(None, Quality.BAD, Reason.SENTINEL, 7)).quality is Quality.BAD


ORDERS = ("ABCD", "CDAB", "BADC", "DCBA")


@given(number=st.integers(-(1 << 31), (1 << 31) - 1), order=st.sampled_from(ORDERS))
def test_encoded_integers_decode_to_the_same_value(number: int, order: str) -> None:
    t = tag(f"type: int32, access: rw, order: {order}")
    assert decode(t, encode(t, number), 1).value == number


@given(number=st.floats(width=32, allow_nan=False, allow_infinity=False), order=st.sampled_from(ORDERS))
def test_encoded_floats_decode_to_the_same_value(number: float, order: str) -> None:
    t = tag(f"type: float32, access: rw, order: {order}")
    raw = encode(t, number)
    assert decode(t, raw, 1).value == number
    if order == "ABCD":
        assert raw == struct.pack(">f", number)


@given(number=st.integers(0, 99_999_999), order=st.sampled_from(ORDERS))
def test_encoded_bcd_decodes_to_the_same_value(number: int, order: str) -> None:
    t = tag(f"type: bcd32, access: rw, order: {order}")
    assert decode(t, encode(t, number), 1).value == number


@pytest.mark.parametrize(
    ("form", "value"),
    [
        ("type: int16, access: rw", 40000),
        ("type: uint16, access: rw", -1),
        ("type: bcd16, access: rw", 10000),
        ("type: float32, access: rw", math.nan),
        ("type: int16, access: rw, range: [1, 5]", 6),
        ("type: uint16, access: rw, bits: [0, 3]", 1),
    ],
)
def test_values_that_a_type_cannot_hold_are_not_written(form: str, value: float) -> None:
    with pytest.raises(NotAllowed):
        encode(tag(form), value)


@pytest.mark.parametrize(
    "form", ["type: float32, bits: [0, 3]", "type: uint16, bits: [4, 16]", "type: uint16, bits: [5, 4]"]
)
def test_bits_that_no_register_has(form: str) -> None:
    with pytest.raises(FileInvalid, match="bits"):
        tag(form)


def test_a_scale_factor_that_does_not_exist_is_refused() -> None:
    with pytest.raises(FileInvalid, match="no tag 'nowhere'"):
        tag("type: int16, scale_by: nowhere")
