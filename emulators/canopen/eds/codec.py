"""CANopen's basic data types as bytes: the emulator's own codec (CiA 301 v4.2, 7.1.6 and table 44).

The gateway's drivers must not use this codec, because the same mistake on both sides of a link would remain undetected.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from functools import partial

BOOLEAN = 0x01
REAL32 = 0x08
VISIBLE_STRING = 0x09
OCTET_STRING = 0x0A
UNICODE_STRING = 0x0B
DOMAIN = 0x0F
REAL64 = 0x11

_SIGNED = {0x02: 8, 0x03: 16, 0x04: 32, 0x10: 24, 0x12: 40, 0x13: 48, 0x14: 56, 0x15: 64}
_UNSIGNED = {0x05: 8, 0x06: 16, 0x07: 32, 0x16: 24, 0x18: 40, 0x19: 48, 0x1A: 56, 0x1B: 64}
_REAL = {REAL32: struct.Struct("<f"), REAL64: struct.Struct("<d")}
_LETTERS = {1: "b", 2: "h", 4: "i", 8: "q"}
"""The `struct` letter of signed integers by size in bytes; the capital letter is the unsigned one."""
_TIME_BYTES = {0x0C: 6, 0x0D: 6}
"""The size in bytes of TIME_OF_DAY and TIME_DIFFERENCE, which this module does not interpret."""

# By data type, made once, because every value needs one.
_INTEGER_BYTES = {BOOLEAN: 1} | {data_type: bits // 8 for data_type, bits in (_SIGNED | _UNSIGNED).items()}
_BYTES = _INTEGER_BYTES | _TIME_BYTES | {data_type: real.size for data_type, real in _REAL.items()}
_RANGES = (
    {BOOLEAN: (0, 1)}
    | {data_type: (-(1 << bits - 1), (1 << bits - 1) - 1) for data_type, bits in _SIGNED.items()}
    | {data_type: (0, (1 << bits) - 1) for data_type, bits in _UNSIGNED.items()}
)


def size_bytes(data_type: int) -> int | None:
    """Return the bytes that a value of `data_type` takes in an SDO; None if the length varies from value to value."""
    return _BYTES.get(data_type)


def is_number(data_type: int) -> bool:
    """Return whether values have an order, so that limits are meaningful."""
    return data_type in _INTEGER_BYTES or data_type in _REAL


def is_integer(data_type: int) -> bool:
    """Return whether the type is one of the integer types or BOOLEAN."""
    return data_type in _INTEGER_BYTES


def integer_range(data_type: int) -> tuple[int, int] | None:
    """Return the smallest and largest value of an integer type or BOOLEAN; None for other types."""
    return _RANGES.get(data_type)


def decode(data_type: int, raw: bytes) -> int | float:
    """Return the number in `raw`, which must have the type's size. Little endian, two's complement."""
    if data_type in _REAL:
        value: float = _REAL[data_type].unpack(raw)[0]
        return value
    return int.from_bytes(raw, "little", signed=data_type in _SIGNED)


def encode(data_type: int, value: int | float) -> bytes:
    """Return the bytes of a number. Raises `ValueError` if it does not fit.

    A signed type also accepts the unsigned form of its bits (0xFFFF for -1), because data sheets write defaults that
    way.
    """
    try:
        if data_type in _REAL:
            return _REAL[data_type].pack(value)
        whole = int(value)
        size = _BYTES.get(data_type)
        if size is None:
            raise ValueError("the type holds no number")
        return whole.to_bytes(size, "little", signed=data_type in _SIGNED and whole < 0)
    except (OverflowError, struct.error) as e:
        raise ValueError("the number does not fit the type") from e


def held_encoder(data_type: int) -> Callable[[int | float], bytes]:
    """Return an encoder that rounds numbers and limits them to the range of the type, like a device whose registers saturate.

    NaN becomes 0 in an integer. Real types accept what `encode` accepts.
    """
    bounds = integer_range(data_type)
    if bounds is None:
        return partial(encode, data_type)
    (low, high), size, signed = bounds, _INTEGER_BYTES[data_type], data_type in _SIGNED
    letter = _LETTERS.get(size)
    pack: Callable[[int], bytes] = partial(int.to_bytes, length=size, byteorder="little", signed=signed)
    if letter is not None:
        pack = struct.Struct("<" + (letter if signed else letter.upper())).pack

    def encode_held(number: int | float) -> bytes:
        try:
            whole = round(number)
        except (OverflowError, ValueError):  # infinite, or not a number
            whole = 0 if math.isnan(number) else bounds[number > 0]
        return pack(low if whole < low else high if whole > high else whole)

    return encode_held


def parse_number(text: str) -> int:
    """Return an integer in the notation of CiA 306: decimal, 0x hexadecimal, or octal with a leading zero.

    Raises `ValueError`.
    """
    text = text.strip()
    if text.lower().startswith(("0x", "-0x", "+0x")):
        return int(text, 16)
    digits = text.lstrip("+-")
    if len(digits) > 1 and digits.startswith("0") and digits.isdigit():
        return int(text, 8)
    return int(text, 10)


def encode_text(data_type: int, text: str) -> bytes:
    """Return the bytes of a value as written in an electronic data sheet (without $NODEID). Raises `ValueError`.

    An empty text is the type's zero, or the empty string. A time is a number of 48 bits, or its six octets as twelve
    digits.
    """
    if data_type == VISIBLE_STRING:
        return text.encode("latin-1", "replace")
    if data_type == UNICODE_STRING:
        return text.encode("utf-16-le")
    size = size_bytes(data_type)
    if size is None:
        return _hex_bytes(text)
    if not text.strip():
        return bytes(size)
    if data_type in _TIME_BYTES:
        octets = len(text.strip()) == 2 * size and not text.strip().lower().startswith("0x")
        return _hex_bytes(text) if octets else _fit(parse_number(text), size)
    if data_type in _REAL and not text.strip().lower().startswith("0x"):
        return encode(data_type, float(text))
    if data_type in _REAL:  # a hexadecimal number is the bit pattern
        return _fit(parse_number(text), size)
    return encode(data_type, parse_number(text))


def _fit(value: int, size: int) -> bytes:
    try:
        return value.to_bytes(size, "little")
    except OverflowError as e:
        raise ValueError("the number does not fit the type") from e


def _hex_bytes(text: str) -> bytes:
    compact = text.replace(" ", "")
    if compact.lower().startswith(
        "0x"
    ):  # written as a number: with an odd number of digits the leading zero was omitted
        compact = compact[2:].zfill(len(compact[2:]) + len(compact) % 2)
    return bytes.fromhex(compact)
