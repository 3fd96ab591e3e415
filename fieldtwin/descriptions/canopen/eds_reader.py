"""Read an EDS or DCF (CiA 306) as a `NodeDescription`. The gateway's reader repairs the text and checks the values."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

from fieldtwin.descriptions.canopen.node import NodeDescription, NodeObject, NodeValue
from fieldtwin.gateway.protocols.canopen.eds.dictionary import DictionaryEntry, ObjectDictionary, parse_dictionary
from fieldtwin.gateway.protocols.canopen.eds.text import EdsText, Section, decode_eds, read_eds_text
from fieldtwin.gateway.protocols.canopen.eds.values import read_value

_OBJECT = re.compile(r"[0-9A-F]{4}")
_FIRST_OBJECT = 0x1000
"""Lower indexes define data types (CiA 301, 7.4.1)."""
_ANY_NODE = 1
"""A node ID to check a value that depends on the node ID; the description keeps its text."""


def read_eds(data: bytes, path: Path) -> tuple[NodeDescription, tuple[str, ...]]:
    """Return the description in an EDS or DCF, and the repairs that its text needed. Raises `FileInvalid`."""
    text, assumed = decode_eds(data, str(path))
    dictionary = parse_dictionary(text, path=str(path), mended=assumed, folder=path.parent)
    eds = read_eds_text(text, str(path))
    objects = tuple(
        _object(eds.sections[f"{index:04X}"], tuple(entries), eds)
        for index, entries in groupby(dictionary, lambda entry: entry.index)
    )
    commissioning = eds.sections["DeviceComissioning"].values
    described = NodeDescription(
        objects,
        dict(eds.sections["DeviceInfo"].values),
        dictionary.node_id,
        int(commissioning.get("Baudrate", "0")) or None,
        commissioning.get("NodeName", ""),
    )
    return described, (*dictionary.mended, *_without_values(eds, dictionary))


def _without_values(eds: EdsText, dictionary: ObjectDictionary) -> Iterator[str]:
    """Yield a message for each object that has no value, such as an array without sub-objects."""
    indexes = {index for index, _ in dictionary.entries}
    for name, section in eds.sections.items():
        if _OBJECT.fullmatch(name) and int(name, 16) >= _FIRST_OBJECT and int(name, 16) not in indexes:
            yield f"[{name}]: left out, {section.values['ParameterName']!r} has no sub-objects (line {section.line})"


def _object(section: Section, entries: tuple[DictionaryEntry, ...], eds: EdsText) -> NodeObject:
    code = int(section.values.get("ObjectType", "0x7"), 0)
    name = section.values["ParameterName"]
    values = []
    for entry in entries:
        own = eds.sections.get(f"{entry.index:04X}sub{entry.subindex:X}") or section
        counted = "CompactSubObj" in own.values and entry.subindex == 0
        values.append(_value(entry, own, entry.name.removeprefix(f"{name}."), counted))
    return NodeObject(entries[0].index, name, code, tuple(values))


def _value(entry: DictionaryEntry, section: Section, name: str, counted: bool) -> NodeValue:
    """Return the value of an entry. `counted` means that it is the number of entries of a compact array."""
    stated = section.values
    return NodeValue(
        entry.index,
        entry.subindex,
        name,
        entry.type_code,
        entry.access,
        default=str(entry.default) if counted else _readable(entry.type_code, stated.get("DefaultValue", "")),
        low="" if entry.low is None else f"{entry.low}",
        high="" if entry.high is None else f"{entry.high}",
        mappable=entry.pdo_mappable,
        configured="" if counted else _readable(entry.type_code, stated.get("ParameterValue", "")),
        unit=stated.get("Unit", ""),
        factor=stated.get("Factor", ""),
        remark=stated.get("Description", ""),
    )


def _readable(type_code: int, text: str) -> str:
    """Return the text of a value; empty if it does not fit its type, which the dictionary's repairs then state."""
    try:
        read_value(type_code, text, _ANY_NODE)
    except (ValueError, OverflowError):
        return ""
    return text
