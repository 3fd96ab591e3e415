"""Decimal numbers of 32-bit floats: a device that holds 2.3 in 32 bits sends 2.2999999523..., and people write 2.3."""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import Any

_FLOAT32 = struct.Struct("<f")
_ENOUGH_DIGITS = 9
"""Nine significant digits identify every 32-bit float (IEEE 754-2019, 5.12.2)."""


def as_decimal(value: Any) -> Any:
    """Return the shortest decimal number that has the same 32-bit float as `value`.

    Other values, and floats that 32 bits cannot hold exactly, are returned unchanged.
    """
    return _shortest(value) if isinstance(value, float) and not value.is_integer() else value


@lru_cache(4096)
def _shortest(value: float) -> float:
    if _rounded(value) != value:
        return value
    candidates = (float(f"{value:.{digits}g}") for digits in range(1, _ENOUGH_DIGITS + 1))
    return next(decimal for decimal in candidates if _rounded(decimal) == value)


def _rounded(value: float) -> float | None:
    """Return the 32-bit float that is nearest to `value`; None if `value` is too large for one."""
    try:
        number: float = _FLOAT32.unpack(_FLOAT32.pack(value))[0]
    except OverflowError:
        return None
    return number
