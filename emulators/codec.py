"""The encoding of an emulated device's values in registers: the emulators' own codec.

It shares no code with the codec of the drivers. A bug in a shared codec would cancel itself out and stay undetected until
the first real device. This module performs no I/O and does not depend on tables or addresses.

A register is 16 bits, sent high byte first (MODBUS Application Protocol V1.1b3, 4.2). The vendor chooses how several
registers form one value. `order` names the choice by the positions of the bytes of the big-endian value:

====  ===========================================  ======================================
ABCD  most significant register first              as most manuals say "big-endian"
CDAB  least significant register first             "word swapped"
BADC  as ABCD, the two bytes of a register swapped  "byte swapped"
DCBA  as CDAB, bytes swapped                       "little-endian"
====  ===========================================  ======================================
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

from fieldtwin.gateway.core.errors import Bug

NUMBERS = {
    "int16": ("h", 1),
    "uint16": ("H", 1),
    "int32": ("i", 2),
    "uint32": ("I", 2),
    "int64": ("q", 4),
    "uint64": ("Q", 4),
    "float32": ("f", 2),
    "float64": ("d", 4),
}
"""Type name -> its struct code and number of registers."""

BCD = {"bcd16": 1, "bcd32": 2}
"""Binary-coded decimals, four digits per register: type name -> number of registers."""

ORDERS = ("ABCD", "CDAB", "BADC", "DCBA")


def register_count(type_name: str, registers: int = 0) -> int:
    """Return how many registers a value of the type takes; a string takes the `registers` of its profile."""
    if type_name == "string":
        if registers < 1:
            raise Bug("a string of no registers")
        return registers
    return BCD[type_name] if type_name in BCD else _number(type_name)[1]


def encode(value: float | int | str, type_name: str, order: str = "ABCD", *, registers: int = 0) -> list[int]:
    """Return `value` as registers, each 0 to 65535, in the order of their addresses.

    Integers are rounded to the nearest value and limited to the type's range, as converters in devices do; NaN as an
    integer is the limit of the type that instruments use for "no value" (0x8000... signed, 0xFFFF... unsigned). A
    float32 that is too large becomes infinite. A string is ASCII, padded with NUL, truncated at the end of its
    registers.
    """
    if type_name == "string":
        raw = str(value).encode("ascii", "replace")
        size = 2 * register_count("string", registers)
        return _split(raw[:size].ljust(size, b"\0"), order, reverse=False)
    if isinstance(value, str):
        raise Bug("text for a number", expected=type_name, got=repr(value))
    if type_name in BCD:
        return _split(_as_digits(value, 4 * BCD[type_name]), order)
    code, _ = _number(type_name)
    if code == "f":
        return _split(_float32(value), order)
    if code == "d":
        return _split(struct.pack(">d", value), order)
    return _split(struct.pack(f">{code}", _as_integer(value, code)), order)


def decode(words: Sequence[int], type_name: str, order: str = "ABCD") -> float | int | str:
    """Return the value that a client wrote into registers. A string ends at its first NUL."""
    if type_name == "string":
        raw = _join(words, order, reverse=False)
        return raw.split(b"\0", 1)[0].decode("ascii", "replace")
    if type_name in BCD:
        return _digits_of(words, type_name, order)
    code, count = _number(type_name)
    if len(words) != count:
        raise Bug(f"registers of a {type_name}", expected=str(count), got=str(len(words)))
    value: float | int = struct.unpack(f">{code}", _join(words, order))[0]
    return value


def _number(type_name: str) -> tuple[str, int]:
    try:
        return NUMBERS[type_name]
    except KeyError:
        raise Bug("unknown type", expected=", ".join([*NUMBERS, *BCD, "string"]), got=repr(type_name)) from None


def _float32(value: float) -> bytes:
    try:
        return struct.pack(">f", value)
    except OverflowError:
        return struct.pack(">f", math.copysign(math.inf, value))


def _as_integer(value: float, code: str) -> int:
    bits = 8 * struct.calcsize(f">{code}")
    low, high = (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if code.islower() else (0, (1 << bits) - 1)
    if math.isnan(value):
        return low if low else high
    if math.isinf(value):
        return high if value > 0 else low
    return min(max(round(value), low), high)


def _as_digits(value: float, digits: int) -> bytes:
    """Return `value` as decimal digits, two per byte, limited to the digits available; NaN as all digits F, which are
    invalid.
    """
    if math.isnan(value):
        return b"\xff" * (digits // 2)
    held = min(max(value, 0.0), 10.0**digits - 1)
    return bytes.fromhex(f"{round(held):0{digits}d}")


def _digits_of(words: Sequence[int], type_name: str, order: str) -> int:
    if len(words) != BCD[type_name]:
        raise Bug(f"registers of a {type_name}", expected=str(BCD[type_name]), got=str(len(words)))
    number = 0
    for byte in _join(words, order):
        number = number * 100 + (byte >> 4) * 10 + (byte & 0x0F)
    return number


def _split(raw: bytes, order: str, *, reverse: bool = True) -> list[int]:
    """Split big-endian bytes into registers. The registers of a string are never reversed; only their bytes are swapped."""
    _check(order)
    words = [raw[i : i + 2] for i in range(0, len(raw), 2)]
    if order in ("CDAB", "DCBA") and reverse:
        words.reverse()
    return [int.from_bytes(word, "little" if order in ("BADC", "DCBA") else "big") for word in words]


def _join(words: Sequence[int], order: str, *, reverse: bool = True) -> bytes:
    _check(order)
    if any(not 0 <= word <= 0xFFFF for word in words):
        raise Bug("not a register", expected="0 to 65535", got=str(list(words)))
    raw = [word.to_bytes(2, "little" if order in ("BADC", "DCBA") else "big") for word in words]
    if order in ("CDAB", "DCBA") and reverse:
        raw.reverse()
    return b"".join(raw)


def _check(order: str) -> None:
    if order not in ORDERS:
        raise Bug("unknown byte order", expected=", ".join(ORDERS), got=repr(order))
