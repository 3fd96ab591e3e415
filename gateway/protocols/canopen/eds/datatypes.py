"""The basic data types of CiA 301 (7.1.6, codes of table 44): conversion between transmitted bytes and Python values.

All numbers are little-endian (7.1.3). This module only converts single values; objects and transfers are handled elsewhere.
"""

from __future__ import annotations

import struct
from enum import IntEnum

from fieldtwin.gateway.core.errors import UsageError, WireError
from fieldtwin.gateway.core.values import Scalar


class DataType(IntEnum):
    """Type codes as in an EDS and in the object dictionary (0001h to 001Bh)."""

    BOOLEAN = 0x01
    INTEGER8 = 0x02
    INTEGER16 = 0x03
    INTEGER32 = 0x04
    UNSIGNED8 = 0x05
    UNSIGNED16 = 0x06
    UNSIGNED32 = 0x07
    REAL32 = 0x08
    VISIBLE_STRING = 0x09
    OCTET_STRING = 0x0A
    UNICODE_STRING = 0x0B
    TIME_OF_DAY = 0x0C
    TIME_DIFFERENCE = 0x0D
    DOMAIN = 0x0F
    INTEGER24 = 0x10
    REAL64 = 0x11
    INTEGER40 = 0x12
    INTEGER48 = 0x13
    INTEGER56 = 0x14
    INTEGER64 = 0x15
    UNSIGNED24 = 0x16
    UNSIGNED40 = 0x18
    UNSIGNED48 = 0x19
    UNSIGNED56 = 0x1A
    UNSIGNED64 = 0x1B


_KINDS = {int(t): t for t in DataType}

_INTEGERS: dict[DataType, tuple[int, bool]] = {
    kind: (int("".join(c for c in kind.name if c.isdigit())) // 8, kind.name.startswith("INTEGER"))
    for kind in DataType
    if kind.name.startswith(("INTEGER", "UNSIGNED"))
}
"""Integer types: number of bytes, and whether signed."""

_REALS = {DataType.REAL32: struct.Struct("<f"), DataType.REAL64: struct.Struct("<d")}
_SIX_BYTES = (DataType.TIME_OF_DAY, DataType.TIME_DIFFERENCE)


class LengthMismatch(WireError):
    """A device sent more or fewer bytes for an object than its data type has."""


def size_of(data_type: int) -> int | None:
    """Return the size of a value of this type in bytes, or None if it varies (strings, DOMAIN) or the type is unknown."""
    kind = _KINDS.get(data_type)
    if kind is None:
        return None
    if kind in _INTEGERS:
        return _INTEGERS[kind][0]
    if kind in _REALS:
        return _REALS[kind].size
    if kind in _SIX_BYTES:
        return 6
    return 1 if kind is DataType.BOOLEAN else None


def is_signed(data_type: int) -> bool:
    """Return whether the type is one of the INTEGER types."""
    kind = _KINDS.get(data_type)
    return kind is not None and _INTEGERS.get(kind, (0, False))[1]


def decode(data_type: int, data: bytes) -> Scalar:
    """Return the value in `data`. Raises `LengthMismatch` if its length differs from that of the type.

    VISIBLE_STRING loses trailing NULs (devices pad with them), and its non-ASCII bytes are written as ``\\xNN``.
    OCTET_STRING, DOMAIN, the two time types and unknown types stay bytes.
    """
    size = size_of(data_type)
    if size is not None and len(data) != size:
        name = DataType(data_type).name
        raise LengthMismatch(f"a value of type {name}", expected=f"{size} bytes", got=f"{len(data)} ({data.hex()})")
    kind = _KINDS.get(data_type)
    if kind is None:
        return data
    if kind in _INTEGERS:
        return int.from_bytes(data, "little", signed=_INTEGERS[kind][1])
    if kind in _REALS:
        return float(_REALS[kind].unpack(data)[0])
    if kind is DataType.BOOLEAN:
        return data != b"\0"
    if kind is DataType.VISIBLE_STRING:
        return data.rstrip(b"\0").decode("ascii", errors="backslashreplace")
    if kind is DataType.UNICODE_STRING:
        return data.decode("utf-16-le", errors="replace").rstrip("\0")
    return data


def encode(data_type: int, value: Scalar) -> bytes:
    """Return the bytes of `value`.

    Raises `UsageError` if it has a wrong type or does not fit; values are never rounded or cut.
    """
    kind = _KINDS.get(data_type, DataType.DOMAIN)
    try:
        return _encode(kind, value)
    except (OverflowError, UnicodeEncodeError, struct.error) as e:
        raise UsageError(f"a value does not fit {kind.name}", got=repr(value)) from e


def _encode(kind: DataType, value: Scalar) -> bytes:
    if kind in _INTEGERS and isinstance(value, int) and not isinstance(value, bool):
        size, signed = _INTEGERS[kind]
        return value.to_bytes(size, "little", signed=signed)
    if kind in _REALS and isinstance(value, (int, float)) and not isinstance(value, bool):
        return _REALS[kind].pack(value)
    if kind is DataType.BOOLEAN and isinstance(value, int) and value in (0, 1):
        return bytes([value])
    if kind is DataType.VISIBLE_STRING and isinstance(value, str):
        return value.encode("ascii")
    if kind is DataType.UNICODE_STRING and isinstance(value, str):
        return value.encode("utf-16-le")
    if kind in (DataType.OCTET_STRING, DataType.DOMAIN) and isinstance(value, bytes):
        return value
    if kind in _SIX_BYTES and isinstance(value, bytes) and len(value) == 6:
        return value
    raise UsageError(f"not a value of type {kind.name}", got=repr(value))
