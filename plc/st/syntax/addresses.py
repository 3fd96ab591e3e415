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
