"""Convert a value that was written to a device from its raw bytes in the journal into a number for a simulation."""

from __future__ import annotations

import struct

from fieldtwin.emulators.codec import decode
from fieldtwin.emulators.modbus.bank import BIT_TABLES
from fieldtwin.gateway.core.files.profile import Tag

_FLOATS = {"float32": "<f", "float64": "<d"}


def number_of(tag: Tag, raw: bytes) -> float:
    """Return the engineering value of `raw`.

    `raw` holds register bytes in the order of their addresses, one byte per bit, or a CANopen object's bytes
    (little-endian, CiA 301, 7.1.4). Scale factors in separate registers are not applied. Text has no number.
    """
    return _plain(tag, raw) * tag.scale + tag.offset


def _plain(tag: Tag, raw: bytes) -> float:
    if tag.at is None:
        if tag.type in _FLOATS:
            return float(struct.unpack(_FLOATS[tag.type], raw)[0])
        number = int.from_bytes(raw, "little", signed=tag.type.startswith("int"))
    elif tag.at.table in BIT_TABLES:
        return float(raw[0])
    else:
        words = [int.from_bytes(raw[i : i + 2]) for i in range(0, len(raw), 2)]
        if tag.bits is None:
            return float(decode(words, tag.type, tag.order))
        number = words[0]
    if tag.bits is None:
        return float(number)
    low, high = tag.bits
    return float(number >> low & (1 << (high - low + 1)) - 1)
