"""Convert the values in an electronic data sheet (CiA 306-1, 4.6.3.2) from text to a number, a string or bytes.

The `canopen` package also reads these texts, but it does not support octal numbers, limits of real types and signed numbers that
are written as their bits, and it does not report a value that it cannot read. This module handles single values, not sections.
"""

from __future__ import annotations

import math
import re
import struct

from fieldtwin.gateway.core.values import Scalar
from fieldtwin.gateway.protocols.canopen.cob_id import NODE_MAX
from fieldtwin.gateway.protocols.canopen.eds.datatypes import DataType, is_signed, size_of

_TEXTS = (DataType.VISIBLE_STRING, DataType.UNICODE_STRING)
_TIMES = (DataType.TIME_OF_DAY, DataType.TIME_DIFFERENCE)
_REALS = {DataType.REAL32: "<f", DataType.REAL64: "<d"}
_OCTAL = re.compile(r"[+-]?0[0-9]+")
_WITH_NODE_ID = re.compile(r"\$NODEID(?:\+(?P<after>[0-9A-FX]+))?|(?P<before>[0-9A-FX]+)\+\$NODEID")


def read_value(data_type: int, text: str, node_id: int | None = None) -> Scalar | None:
    """Return the value of `text` for an object of `data_type`; None if it needs a node ID and none is given.

    Raises `ValueError` for a text that is not a value of the type, or is outside its range. A signed type also accepts a number
    that is written as its bits (FFh for -1). A time is written as six octets, or as a number of 48 bits.
    """
    text = text.strip()
    if data_type in _TEXTS:
        return text.encode("latin-1", "replace").decode("ascii", "backslashreplace") if data_type == 9 else text
    size = size_of(data_type)
    if size is None or (data_type in _TIMES and len(text) == 2 * size and text[:2].lower() != "0x"):
        return _octets(text)
    if data_type in _TIMES:
        return _whole(text).to_bytes(size, "little")
    if data_type in _REALS:
        return _real(_REALS[DataType(data_type)], text, size)
    if data_type == DataType.BOOLEAN:
        return _held(_whole(text), 1, signed=False) != 0
    relative = text.replace(" ", "").upper()
    if "$NODEID" not in relative:
        return _held(_whole(text), size, signed=is_signed(data_type))
    match = _WITH_NODE_ID.fullmatch(relative)
    if match is None:
        raise ValueError("neither a number, nor a number and the node id")
    base = _held(_whole(match["after"] or match["before"] or "0"), size, signed=is_signed(data_type))
    _held(base + NODE_MAX, size, signed=is_signed(data_type))  # the type has room for every node id
    return None if node_id is None else base + node_id


def read_limit(data_type: int, text: str) -> int | float | None:
    """Return the limit in `text`; None if values of the type have no order, or if it depends on the node ID.

    Raises `ValueError` for a text that is not a number of the type.
    """
    ordered = size_of(data_type) is not None and data_type not in _TIMES
    if not text.strip() or not ordered or "$NODEID" in text.upper():
        return None
    if data_type == DataType.BOOLEAN:
        return _held(_whole(text), 1, signed=False)
    value = read_value(data_type, text)
    assert isinstance(value, int | float)
    if math.isnan(value):
        raise ValueError("no value is above or below it")
    return value


def _whole(text: str) -> int:
    """Read a decimal number, a hexadecimal one with 0x, or an octal one with a leading zero."""
    text = text.strip()
    if _OCTAL.fullmatch(text):
        return int(text, 8)
    return int(text, 16 if text.lstrip("+-")[:2].lower() == "0x" else 10)


def _held(value: int, size: int, *, signed: bool) -> int:
    """Return `value` as a number of an integer type of `size` bytes. For a signed type, the bits of a negative number are
    converted to that number (FFh to -1). Raises `ValueError` if `value` does not fit.
    """
    bits = 8 * size
    if not (-(1 << bits - 1) if signed else 0) <= value < 1 << bits:
        raise ValueError("the type has no room for it")
    return value - (1 << bits) if signed and value >= 1 << bits - 1 else value


def _real(form: str, text: str, size: int) -> float:
    """Return a number of a REAL type of `size` bytes; `form` is its `struct` format. A hexadecimal number is read as the bits of
    the floating-point number. Raises `ValueError` if it does not fit.
    """
    try:
        raw = _whole(text).to_bytes(size, "little") if text[:2].lower() == "0x" else struct.pack(form, float(text))
    except OverflowError as e:
        raise ValueError("the type has no room for it") from e
    return float(struct.unpack(form, raw)[0])


def _octets(text: str) -> bytes:
    digits = "".join(text.split())
    if digits[:2].lower() == "0x":
        digits = digits[2:]
        digits = digits.zfill(len(digits) + len(digits) % 2)
    return bytes.fromhex(digits)
