"""Data types, PDO mappings and EMCY messages: pure, in both directions, and with arbitrary bytes."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.errors import Desync, UsageError
from fieldtwin.gateway.core.values import Scalar
from fieldtwin.gateway.protocols.canopen.eds.datatypes import (
    DataType,
    LengthMismatch,
    decode,
    encode,
    is_signed,
    size_of,
)
from fieldtwin.gateway.protocols.canopen.emcy import parse_emcy
from fieldtwin.gateway.protocols.canopen.pdo.mapping import PdoEntry, PdoLengthMismatch, PdoMapping


@pytest.mark.parametrize(
    ("kind", "value", "data"),
    [
        (DataType.BOOLEAN, True, "01"),
        (DataType.INTEGER8, -1, "FF"),
        (DataType.INTEGER16, -2, "FEFF"),
        (DataType.INTEGER24, -3, "FDFFFF"),
        (DataType.INTEGER32, 0x01020304, "04030201"),
        (DataType.INTEGER64, -(2**63), "0000000000000080"),
        (DataType.UNSIGNED8, 255, "FF"),
        (DataType.UNSIGNED16, 0x1017, "1710"),
        (DataType.UNSIGNED24, 0x010203, "030201"),
        (DataType.UNSIGNED32, 0x80000185, "85010080"),
        (DataType.UNSIGNED56, 1, "01000000000000"),
        (DataType.UNSIGNED64, 2**64 - 1, "FFFFFFFFFFFFFFFF"),
        (DataType.REAL32, 1.5, "0000C03F"),
        (DataType.REAL64, -2.0, "00000000000000C0"),
        (DataType.VISIBLE_STRING, "ctd", "637464"),
        (DataType.UNICODE_STRING, "é", "E900"),
        (DataType.OCTET_STRING, b"\x01\x00", "0100"),
        (DataType.DOMAIN, b"", ""),
        (DataType.TIME_OF_DAY, b"\x01\x02\x03\x04\x05\x06", "010203040506"),
    ],
)
def test_values_and_bytes(kind: DataType, value: Scalar, data: str) -> None:
    assert encode(kind, value) == bytes.fromhex(data)
    assert decode(kind, bytes.fromhex(data)) == value


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (DataType.INTEGER8, 128),
        (DataType.UNSIGNED16, -1),
        (DataType.UNSIGNED16, 1.5),
        (DataType.UNSIGNED8, True),
        (DataType.REAL32, 1e39),
        (DataType.REAL32, "1"),
        (DataType.VISIBLE_STRING, "é"),
        (DataType.BOOLEAN, 2),
        (DataType.DOMAIN, "text"),
        (DataType.TIME_OF_DAY, b"\x01"),
    ],
)
def test_values_that_do_not_fit_are_refused(kind: DataType, value: Scalar) -> None:
    with pytest.raises(UsageError):
        encode(kind, value)


@given(kind=st.sampled_from(list(DataType)), data=st.binary(max_size=12))
def test_any_bytes_decode_or_have_the_wrong_length(kind: DataType, data: bytes) -> None:
    size = size_of(kind)
    if size is not None and len(data) != size:
        with pytest.raises(LengthMismatch):
            decode(kind, data)
        return
    value = decode(kind, data)
    if size is not None and kind is not DataType.BOOLEAN and not (isinstance(value, float) and math.isnan(value)):
        assert encode(kind, value) == data


def test_strings_lose_only_their_padding() -> None:
    assert decode(DataType.VISIBLE_STRING, b"a\0b\xb0\0\0") == "a\0b\\xb0"
    assert decode(0x40, b"\x01") == b"\x01"
    assert size_of(0x40) is None
    assert is_signed(0x10)
    assert not is_signed(0x05)


SLOPES = PdoMapping.of([(0x6010, 0, 16), (0x6020, 0, 16)])


def test_a_mapping_is_read_from_the_nodes_words() -> None:
    assert PdoMapping.from_words([0x60100010, 0x60200010]) == SLOPES
    assert [e.word for e in SLOPES.entries] == [0x60100010, 0x60200010]
    assert (SLOPES.bits, SLOPES.length) == (32, 4)


def test_objects_are_cut_out_in_order() -> None:
    assert SLOPES.unpack(bytes.fromhex("FEFF0302")) == (b"\xfe\xff", b"\x03\x02")
    bits = PdoMapping.of([(0x2000, 1, 1), (0x2000, 2, 3), (0x2000, 3, 12)])
    assert bits.unpack(bytes.fromhex("1B12")) == (b"\x01", b"\x05", b"\x21\x01")


def test_co043_too_short_is_not_used_too_long_gives_its_first_bytes() -> None:
    with pytest.raises(PdoLengthMismatch, match="4 bytes"):
        SLOPES.unpack(b"\x01\x02\x03")
    assert SLOPES.unpack(bytes.fromhex("0100020003")) == (b"\x01\x00", b"\x02\x00")
    with pytest.raises(PdoLengthMismatch):
        SLOPES.unpack(bytes.fromhex("0100020003"), exact=True)


def test_an_impossible_mapping_is_refused() -> None:
    with pytest.raises(UsageError):
        PdoMapping.of([(0x6010, 0, 32), (0x6020, 0, 40)])
    with pytest.raises(UsageError):
        PdoMapping((PdoEntry(0x6010, 0, 0),))
    with pytest.raises(Desync):
        PdoMapping.from_words([0x60100000])


@given(bits=st.lists(st.integers(1, 32), max_size=12).filter(lambda b: sum(b) <= 64), data=st.binary(max_size=8))
def test_extracted_bits_can_be_reassembled(bits: list[int], data: bytes) -> None:
    mapping = PdoMapping.of([(0x2000, i, n) for i, n in enumerate(bits)])
    if len(data) < mapping.length:
        with pytest.raises(PdoLengthMismatch):
            mapping.unpack(data)
        return
    used = int.from_bytes(data, "little") & ((1 << mapping.bits) - 1)
    assert mapping.pack(mapping.unpack(data)) == used.to_bytes(mapping.length, "little")


@given(data=st.binary(max_size=8))
def test_co053_any_emcy(data: bytes) -> None:
    if len(data) < 2:
        with pytest.raises(Desync):
            parse_emcy(data)
        return
    emcy = parse_emcy(data)
    assert emcy.length == len(data)
    assert emcy.meaning
    assert (emcy.register is None) == (len(data) < 3)
