"""Choose the values of a new site's devices that the gateway serves to an HMI, and their registers.

The values of a device are adjacent, and so are their quality registers, so that an HMI reads each with few requests. A read of
a bad value is refused as a whole; it then affects neither other devices nor the quality registers.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from fieldtwin.gateway.core.files.profile import REGISTERS_OF, Tag

SPACING = 1000
"""Distance between the first registers of two devices. 64 devices fit into the addresses of a table."""
QUALITY_OFFSET = 500
"""Distance from the first value of a device to its first quality register."""
_EXACT = ("int32", "uint32", "int64", "uint64")
"""Types of values that a float32 cannot hold exactly."""


@dataclass(frozen=True, slots=True)
class ServedValue:
    """A tag, the type and the input register at which it is served, and its quality register."""

    tag: str
    type: str
    address: int
    quality: int


def served_values(tags: Iterable[Tag], place: int) -> list[ServedValue]:
    """Return the values of the device number `place` (0 to 63) of a site, as many as fit before its quality registers.

    Texts, bytes and secrets are left out.
    """
    first = place * SPACING
    found: list[ServedValue] = []
    address = first
    for tag in tags:
        if tag.is_text or tag.secret or not tag.readable or tag.type == "bytes":
            continue
        exact = tag.type == "float64" or (tag.type in _EXACT and (tag.scale, tag.offset, tag.scale_by) == (1, 0, None))
        kind = tag.type if exact else "float32"
        if address + REGISTERS_OF[kind] > first + QUALITY_OFFSET:
            break
        found.append(ServedValue(tag.name, kind, address, first + QUALITY_OFFSET + len(found)))
        address += REGISTERS_OF[kind]
    return found
