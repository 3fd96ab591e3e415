"""Tag values as registers for those who read us, and back. Pure; big endian on the wire (AP 4.2), `order` as in profiles."""

from __future__ import annotations

import math
import struct

from fieldtwin.gateway.core.values import Scalar
from fieldtwin.gateway.devices.codec import reorder

FORMATS = {
    "bool": ">H", "int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "int64": ">q", "uint64": ">Q",
    "float32": ">f", "float64": ">d",
}  # fmt: skip
REGISTERS = {name: struct.calcsize(text) // 2 for name, text in FORMATS.items()}


def pack(kind: str, order: str, value: Scalar | None) -> bytes | None:
    """The registers of `value`, None where the type cannot hold it: it is never cut down to what fits.

    A number goes into an integer type rounded.
    """
    if value is None or isinstance(value, str | bytes) or not math.isfinite(value):
        return None
    number: float = value if kind.startswith("float") else round(value)
    if kind == "bool":
        number = int(bool(value))
    try:
        return reorder(struct.pack(FORMATS[kind], number), order)
    except (struct.error, OverflowError):
        return None


def not_a_number(kind: str, order: str) -> bytes | None:
    """The registers that say that there is no value; None where the type has none that could not be one."""
    return reorder(struct.pack(FORMATS[kind], math.nan), order) if kind.startswith("float") else None


def unpack(kind: str, order: str, data: bytes) -> float | None:
    """The number in a tag's registers; None where it is none."""
    number: float = struct.unpack(FORMATS[kind], reorder(data, order))[0]
    if kind == "bool":
        return float(number) if number in (0, 1) else None
    return number if math.isfinite(number) else None
