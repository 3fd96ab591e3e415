"""Compare the two readers of electronic data sheets: the emulated node's and the gateway's (decision 0001)."""

from __future__ import annotations

import math

from fieldtwin.emulators.canopen.eds.dictionary import Dictionary
from fieldtwin.gateway.core.values import Scalar
from fieldtwin.gateway.protocols.canopen.eds.datatypes import decode
from fieldtwin.gateway.protocols.canopen.eds.dictionary import DictionaryEntry, ObjectDictionary

NODE = 5
TYPE_AREA = 0x1000
"""Indices below this one define data types; the gateway does not store them."""


def differences(node: Dictionary, master: ObjectDictionary, node_id: int = NODE) -> list[str]:
    """Return the differences between the readers, one line for each object and property."""
    of_node = {entry.key: entry for entry in node.entries() if entry.index >= TYPE_AREA}
    of_master = dict(master.entries)
    found: list[str] = []
    for key in sorted(of_node.keys() | of_master.keys()):
        name = f"{key[0]:04X}:{key[1]:02X}"
        if key not in of_node or key not in of_master:
            found.append(f"{name} is known to the {'node' if key in of_node else 'gateway'} only")
            continue
        one, two = of_node[key], of_master[key]
        pairs: list[tuple[str, object, object]] = [
            ("data type", one.data_type, two.type_code),
            ("access", one.access, two.access),
            ("PDO mapping", one.mappable, two.pdo_mappable),
            ("low limit", one.low, two.low),
            ("high limit", one.high, two.high),
        ]
        found += [f"{name} {what}: {left!r} and {right!r}" for what, left, right in pairs if left != right]
        if not _same_default(one.initial(node_id), two):
            found.append(f"{name} default: {one.initial(node_id).hex()} and {two.default!r}")
    return found


def _same_default(raw: bytes, entry: DictionaryEntry) -> bool:
    """If the file has no readable default, it is None for the gateway and zeros for the node.

    For an unreadable ParameterValue the gateway stores that one was present, so that it does not configure a node with a part
    of the file; the node starts with its DefaultValue.
    """
    if entry.default is None:
        return entry.configured or not any(raw)
    value: Scalar = decode(entry.type_code, raw)
    if isinstance(value, float) and isinstance(entry.default, float) and math.isnan(value):
        return math.isnan(entry.default)
    return value == entry.default
