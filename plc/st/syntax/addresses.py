"""Direct addresses (IEC 61131-3:2013, 6.5.5 and table 16): ``%IX0.0``, ``%QW3``, ``%MD4``, and ``%I*`` for one not known yet."""

from __future__ import annotations

import re

_ADDRESS = re.compile(r"%([IQM])([XBWDL]?)(\d+(?:\.\d+)*)", re.IGNORECASE)


def address_of(location: str) -> str:
    """Return an address in its normal form, such as ``%QX0.0`` for ``%q0.00``; "" for ``%I*`` and for no address."""
    found = _ADDRESS.fullmatch(location)
    if found is None:
        return ""
    area, size, numbers = found.groups()
    return f"%{area.upper()}{size.upper() or 'X'}{'.'.join(str(int(number)) for number in numbers.split('.'))}"


def area_of(location: str) -> str:
    """Return I, Q or M; "" for a variable without an address."""
    return location[1:2].upper()


def short_name(address: str) -> str:
    """Return the name of a variable that only its address names, such as ``QX0_0`` for ``%QX0.0``."""
    return address[1:].replace(".", "_")


_BYTES = {"B": 1, "W": 2, "D": 4, "L": 8}


def bits_of(address: str, *, in_bytes: bool) -> range:
    """Return the bits of an area that an address in its normal form has in systems where the sizes overlap.

    The number in ``%MW3`` counts bytes with `in_bytes`, as in TwinCAT, otherwise words, as CODESYS does by default. The range is
    empty for an address of a different form.
    """
    size, numbers = address[2:3], [int(number) for number in address[3:].split(".")]
    if size == "X" and len(numbers) == 2 and numbers[1] < 8:
        first = 8 * numbers[0] + numbers[1]
        return range(first, first + 1)
    if size in _BYTES and len(numbers) == 1:
        first = 8 * numbers[0] * (1 if in_bytes else _BYTES[size])
        return range(first, first + 8 * _BYTES[size])
    return range(0)
