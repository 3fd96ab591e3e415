"""Tag values as registers for the gateway's clients, and back. Registers are big-endian (AP 4.2); `order` is the byte order
as in profiles.
"""

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
    """Return the registers of `value`; None if the type cannot hold it, because a value is never truncated to fit.

    A number is rounded for an integer type.
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
    """Return the registers that mean "no value" (NaN); None if the type has no value outside its normal range."""
    return reorder(struct.pack(FORMATS[kind], math.nan), order) if kind.startswith("float") else None


def unpack(kind: str, order: str, data: bytes) -> float | None:
    """Return the number in a tag's registers; None if they do not hold a valid one."""
    number: float = struct.unpack(FORMATS[kind], reorder(data, order))[0]
    if kind == "bool":
        return float(number) if number in (0, 1) else None
    return number if math.isfinite(number) else None
