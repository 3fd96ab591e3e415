"""The format DBC: the PDOs of a CANopen node as messages and signals, for tools that decode CAN traffic.

A DBC has no object dictionary, no node ID and no SDO, so it is only exported. The library `cantools` writes it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fieldtwin.descriptions.canopen.node import NodeDescription, NodeValue, mapped_words, numbers_of
from fieldtwin.descriptions.canopen.node_of_profile import (
    object_names,
    poll_groups_lost,
    read_profile_eds,
    tag_losses,
)
from fieldtwin.descriptions.canopen.tag_names import type_name
from fieldtwin.descriptions.conversion import Exported, Loss, Settings, losses_of_keys, require_protocol, whole_setting
from fieldtwin.descriptions.profile_text import printable
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile, Tag
from fieldtwin.gateway.protocols.canopen.configure import PDO_INVALID
from fieldtwin.gateway.protocols.canopen.eds.datatypes import DataType, is_signed, size_of
from fieldtwin.gateway.protocols.canopen.pdo.mapping import PdoEntry, PdoMapping
from fieldtwin.installation import install_hint

TITLE = "DBC"
_KINDS = (("TPDO", 0x1800, 0x1A00), ("RPDO", 0x1400, 0x1600))
_PDOS = 512
_EXTENDED = 1 << 29
"""Bit of a COB-ID: the CAN-ID has 29 bits (CiA 301, 7.5.2.35)."""
_DUMMIES = range(1, 0x20)
"""Indexes of data types, which a mapping names for bits without a value."""
_REALS = (DataType.REAL32, DataType.REAL64)
_MASTER = "master"
_KEYS = dict.fromkeys(
    ("source", "timing", "identify", "commands", "behaviours", "trigger", "sampled", "effects"),
    "a DBC describes frames on the bus, not a device",
)


@dataclass(frozen=True, slots=True)
class Pdo:
    """A PDO of a node that exists: `kind` is TPDO or RPDO, `number` counts from 1, `transmission` is the transmission type."""

    kind: str
    number: int
    can_id: int
    extended: bool
    transmission: int | None
    mapping: PdoMapping


def export_description(profile: DeviceProfile, settings: Settings) -> Exported:
    """Return a DBC with a message for each PDO that the profile's EDS or DCF maps, and a signal for each mapped object.

    The node ID determines the CAN-IDs: that of `settings`, else of the DCF, else of the profile's `factory`. Raises `UsageError`
    if `cantools` is missing or for a profile that is not of a CANopen device, `FileInvalid` if no PDO is mapped.
    """
    try:
        from cantools.database.can import Database, Node
    except ImportError as e:
        raise UsageError("DBC needs cantools", hint=install_hint("dbc")) from e
    require_protocol(profile, "canopen", TITLE)
    node, _ = read_profile_eds(profile)
    node_id = whole_setting(settings, "node", 1, 127) or node.node_id or profile.form.factory.node
    losses = [*losses_of_keys(profile, _KEYS)]
    pdos = [*pdos_of(node, node_id, losses)]
    if not pdos:
        raise FileInvalid(
            "no PDO of this node is mapped",
            path=str(profile.eds_path),
            expected="mapping parameters from 1600h or 1A00h on",
        )
    name = _identifier(Path(profile.path).stem)
    values = {(v.index, v.subindex): v for v in node.values()}
    tags = {tag.object: tag for tag in profile.tags.values() if tag.object is not None}
    names = _signal_names(node, tags)
    messages = [_message(pdo, name, values, tags, names, losses) for pdo in pdos]
    losses += _tags_lost(profile, {(e.index, e.subindex) for pdo in pdos for e in pdo.mapping.entries})
    text = Database(
        messages=messages, nodes=[Node(name, f"node ID {node_id}"), Node(_MASTER)], version=""
    ).as_dbc_string()
    content = text.encode("cp1252", "replace")
    if content.decode("cp1252") != text:
        losses.append(Loss("texts", "characters that Windows-1252 lacks", "tools read a DBC in this encoding"))
    return Exported(content, tuple(losses))


def pdos_of(node: NodeDescription, node_id: int, losses: list[Loss]) -> Iterator[Pdo]:
    """Yield the PDOs that map objects and exist (bit 31 of the COB-ID is 0). Note those that map objects, but do not exist."""
    objects = {each.index: each for each in node.objects}
    for kind, communication, mapping in _KINDS:
        for at in range(_PDOS):
            record, mapped = objects.get(communication + at), objects.get(mapping + at)
            if record is None or mapped is None:
                continue
            listed, stated = mapped_words(mapped, node_id), numbers_of(record, node_id)
            cob_id, place = stated.get(1, PDO_INVALID), f"{kind}{at + 1}"
            if listed and cob_id & PDO_INVALID:
                losses.append(Loss(place, "the PDO", "its COB-ID says that it does not exist (bit 31)"))
            elif listed:
                try:
                    found = PdoMapping(tuple(PdoEntry.from_word(word) for word in listed))
                except FieldtwinError as e:
                    losses.append(Loss(place, "the PDO", f"its mapping is not valid: {e.message}"))
                    continue
                extended = bool(cob_id & _EXTENDED)
                can_id = cob_id & (0x1FFFFFFF if extended else 0x7FF)
                yield Pdo(kind, at + 1, can_id, extended, stated.get(2), found)


def _signal_names(node: NodeDescription, tags: Mapping[tuple[int, int], Tag]) -> dict[tuple[int, int], str]:
    """Return a name for each object: that of its tag, else one made from the name of the object; all names differ."""
    taken = {tag.name for tag in tags.values()}
    names = {}
    for (index, subindex), name in object_names(node).items():
        tag = tags.get((index, subindex))
        other = f"{name}_{index:04x}_{subindex:02x}" if name in taken else name
        names[index, subindex] = tag.name if tag is not None else other
    return names


def _message(
    pdo: Pdo,
    node: str,
    values: Mapping[tuple[int, int], NodeValue],
    tags: Mapping[tuple[int, int], Tag],
    names: Mapping[tuple[int, int], str],
    losses: list[Loss],
) -> Any:
    """Return the message of a PDO. The signals of a TPDO come from the node, those of an RPDO from the master."""
    from cantools.database.can import Message

    sender, receiver = (node, _MASTER) if pdo.kind == "TPDO" else (_MASTER, node)
    signals, at, used = [], 0, set[str]()
    for entry in pdo.mapping.entries:
        key, start = (entry.index, entry.subindex), at
        at += entry.bits
        if entry.index in _DUMMIES:
            continue
        name = names.get(key, f"object_{entry.index:04x}_{entry.subindex:02x}")
        if name in used:
            losses.append(Loss(f"{pdo.kind}{pdo.number}", f"the second signal {name}", "names in a message differ"))
            continue
        used.add(name)
        signals.append(_signal(entry, start, name, values.get(key), tags.get(key), receiver, losses))
    transmission = "" if pdo.transmission is None else f", transmission type {pdo.transmission}"
    return Message(
        pdo.can_id,
        f"{node}_{pdo.kind}{pdo.number}",
        pdo.mapping.length,
        signals,
        comment=f"{pdo.kind}{pdo.number}{transmission}",
        senders=[sender],
        is_extended_frame=pdo.extended,
    )


def _signal(
    entry: PdoEntry, start: int, name: str, value: NodeValue | None, tag: Tag | None, receiver: str, losses: list[Loss]
) -> Any:
    """Return the signal of a mapped object: little-endian, engineering value = raw x scale + offset."""
    from cantools.database.can import Signal
    from cantools.database.conversion import BaseConversion

    code = value.type_code if value is not None else 0
    size = size_of(code)
    if size is None or (code != DataType.BOOLEAN and 8 * size != entry.bits):
        why = f"{entry.bits} bits of type {type_name(code)} are an unsigned number in a DBC"
        losses.append(Loss(f"signal {name}", "its type", why))
        code = 0
    choices: OrderedDict[int, Any] | None = OrderedDict(tag.values) if tag is not None and tag.values else None
    scale, offset = (tag.scale, tag.offset) if tag is not None else (1.0, 0.0)
    low, high = tag.range if tag is not None and tag.range is not None else (None, None)
    return Signal(
        name,
        start,
        entry.bits,
        is_signed=is_signed(code),
        conversion=BaseConversion.factory(_plain(scale), _plain(offset), choices, code in _REALS),
        minimum=low,
        maximum=high,
        unit=printable(tag.unit) if tag is not None and tag.unit else None,
        comment=printable(f"{entry.index:04X}h:{entry.subindex:02X} {value.name if value is not None else ''}"),
        receivers=[receiver],
    )


def _plain(number: float) -> float:
    return int(number) if number == int(number) else number


def _tags_lost(profile: DeviceProfile, mapped: set[tuple[int, int]]) -> Iterator[Loss]:
    for tag in profile.tags.values():
        if tag.object not in mapped:
            yield Loss(f"tag {tag.name}", "the tag", "no PDO carries its object")
            continue
        yield from tag_losses(tag, "a DBC has no place for it")
    yield from poll_groups_lost(profile)


def _identifier(text: str) -> str:
    """Return `text` as a name of a DBC: letters, digits and underscores, beginning with a letter."""
    kept = "".join(c if c.isascii() and c.isalnum() else "_" for c in text)
    return kept if kept[:1].isalpha() else f"n{kept}"
