"""Parse the addresses and names of a command line into tags: ``holding:100``, ``40101``, ``6040h:00``, or a tag of a profile.

The module only handles text. A raw address becomes a tag named as the user wrote it, so that all later steps handle only tags
and decode them with the gateway's codec.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.profile import (
    INTEGER_RANGES,
    REGISTERS_OF,
    DeviceProfile,
    RegisterRange,
    Tag,
    resolve_address,
)
from fieldtwin.gateway.devices.data_sheet import TAG_TYPES
from fieldtwin.gateway.protocols.canopen.eds.datatypes import DataType
from fieldtwin.gateway.protocols.canopen.eds.dictionary import DictionaryEntry, ObjectDictionary

AUTO = "auto"
"""The type of a CANopen object whose type is not stated: it follows from the length of the data."""

ORDERS = ("ABCD", "CDAB", "BADC", "DCBA")
TYPES = (*REGISTERS_OF, "int8", "uint8", "string", "bytes")

_OBJECT = re.compile(r"^(?:0x)?([0-9A-Fa-f]{4})h?(?:[:.]([0-9A-Fa-f]{1,2})h?)?$")
_REGISTER = re.compile(r"^(?:(?:coil|discrete|input|holding):.*|[0-9]{5,6})$")
_STORING = {0x1010: "stores parameters", 0x1011: "restores factory values"}


@dataclass(frozen=True, slots=True)
class RawForm:
    """The interpretation of raw addresses.

    `type` None is uint16 for registers and bool for bits; for an object the type then follows from the length of the data.
    `registers` is the length of a text in registers; `count` is the number of consecutive values.
    """

    type: str | None = None
    order: str = "ABCD"
    count: int = 1
    registers: int = 1

    def __post_init__(self) -> None:
        if self.type is not None and self.type not in TYPES:
            raise UsageError("no such type", expected=", ".join(TYPES), got=self.type)
        if self.order not in ORDERS:
            raise UsageError("no such byte order", expected=", ".join(ORDERS), got=self.order)
        if not 1 <= self.count <= 2000 or not 1 <= self.registers <= 125:
            raise UsageError("count or length out of range", expected="1 to 2000 values, 1 to 125 registers")


def of_behaviour(name: str, profile: DeviceProfile | None) -> list[str]:
    """Return the writes that a profile defines for the behaviour `name`, as ``TAG=VALUE``, in its order. Raises `UsageError`."""
    if profile is None:
        raise UsageError(f"the behaviour {name!r} needs a profile", expected="--profile NAME")
    if name not in profile.form.behaviours:
        known = ", ".join(profile.form.behaviours) or "none"
        raise UsageError(f"{profile.name} has no behaviour {name!r}", expected=known)
    return [f"{profile.form.commands[command]}={value}" for command, value in profile.form.behaviours[name].items()]


def tags_of(
    items: Sequence[str],
    protocol: str,
    form: RawForm | None = None,
    profile: DeviceProfile | None = None,
    dictionary: ObjectDictionary | None = None,
) -> list[Tag]:
    """Return the tags that `items` name, in their order and each once.

    Without items: every readable tag of the profile, or else every readable object of the EDS except DOMAIN objects (files).

    A name is looked up in the profile first (a shell pattern selects all matching tags: ``voltage_*``), then in the EDS; the rest
    are raw addresses. Raises `UsageError`, which contains the item and similar names.
    """
    form = form or RawForm()
    if not items:
        if profile is None and dictionary is not None:
            return [tag_of_entry(e) for e in dictionary if e.access != "wo" and e.type_code != DataType.DOMAIN]
        if profile is None:
            example = "holding:100" if protocol == "modbus" else "6041h:00"
            raise UsageError("nothing to read", expected=f"an address such as {example}, or --profile NAME")
        return [t for t in profile.tags.values() if t.readable]
    found: dict[str, Tag] = {}
    for item in items:
        found |= {tag.name: tag for tag in _tags(item, protocol, form, profile, dictionary)}
    return list(found.values())


def _tags(
    item: str, protocol: str, form: RawForm, profile: DeviceProfile | None, dictionary: ObjectDictionary | None
) -> list[Tag]:
    if profile is not None:
        named = _by_name(item, profile.tags)
        if named:
            return named
    if protocol == "modbus" and _REGISTER.match(item):
        return _registers(item, form)
    if protocol == "canopen" and (match := _OBJECT.match(item)):
        index, sub = int(match[1], 16), int(match[2] or "0", 16)
        known = {t.object: t for t in profile.tags.values()} if profile is not None and form.type is None else {}
        return [known.get(tag.object, tag) for tag in _objects(index, sub, form, dictionary)]
    if dictionary is not None:
        entry = dictionary.find(item)
        return [tag_of_entry(entry)]
    names = list(profile.tags) if profile is not None else []
    raw = "holding:100 or 40101" if protocol == "modbus" else "6041h:00"
    raise UsageError(
        f"there is no value or function {item!r}",
        expected=f"{'a tag of the profile, or ' if names else ''}an address such as {raw}",
        hint=did_you_mean(item, names),
    )


def _by_name(item: str, tags: Mapping[str, Tag]) -> list[Tag]:
    if item in tags:
        return [tags[item]]
    if not set(item) & set("*?["):
        return []
    pattern = re.compile("".join({"*": ".*", "?": "."}.get(c, re.escape(c)) for c in item))
    return [tag for name, tag in tags.items() if pattern.fullmatch(name)]


def with_care(tag: Tag, profile: DeviceProfile | None) -> Tag:
    """Return a raw address marked as dangerous or nonvolatile if an overlapping tag of the profile is, so that a raw address
    does not bypass these checks.
    """
    if profile is None or tag.name in profile.tags or tag.at is None:
        return tag
    at = tag.at
    there = [t for t in profile.tags.values() if t.at is not None and t.at.overlaps(at)]
    dangers = " and ".join(dict.fromkeys(t.danger for t in there if t.danger))
    return replace(tag, danger=dangers, nonvolatile=any(t.nonvolatile for t in there))


def _registers(item: str, form: RawForm) -> list[Tag]:
    try:
        first = resolve_address(item, "printed")
        bits = first.table in ("coil", "discrete")
        kind = form.type or ("bool" if bits else "uint16")
        if kind in ("int8", "uint8") or (bits and kind != "bool"):
            raise ValueError(f"a {kind} does not fit the table {first.table}")
        step = REGISTERS_OF.get(kind, form.registers)
        whole = resolve_address(item, "printed", step * form.count)
    except ValueError as e:
        raise UsageError(str(e)) from e
    return [
        raw_tag(
            f"{whole.table}:{whole.address + i * step}",
            kind,
            at=RegisterRange(whole.table, whole.address + i * step, step),
            order=form.order,
        )
        for i in range(form.count)
    ]


def _objects(index: int, sub: int, form: RawForm, dictionary: ObjectDictionary | None) -> list[Tag]:
    if sub + form.count > 256:
        raise UsageError("the subindices end at FFh", got=f"{sub:02X}h with {form.count} values")
    tags = []
    for i in range(sub, sub + form.count):
        entry = dictionary.get(index, i) if dictionary is not None else None
        if entry is not None and form.type is None:
            tags.append(replace(tag_of_entry(entry), name=object_name(index, i)))
        else:
            tags.append(raw_tag(object_name(index, i), form.type or AUTO, object_=(index, i)))
    return tags


def object_name(index: int, subindex: int) -> str:
    """Return a text such as ``6041h:00``."""
    return f"{index:04X}h:{subindex:02X}"


def tag_of_entry(entry: DictionaryEntry) -> Tag:
    """Return an entry of an EDS as a tag, with type, access and limits of the file."""
    kind = TAG_TYPES.get(entry.type_code, "bytes")
    limits = None
    if kind in INTEGER_RANGES and (entry.low is not None or entry.high is not None):
        low, high = INTEGER_RANGES[kind]
        limits = (float(low if entry.low is None else entry.low), float(high if entry.high is None else entry.high))
    access = "wo" if entry.access == "wo" else "rw" if entry.writable else "ro"
    tag = raw_tag(entry.name, kind, object_=(entry.index, entry.subindex))
    return replace(tag, access=access, range=limits)


def raw_tag(
    name: str,
    kind: str,
    *,
    at: RegisterRange | None = None,
    object_: tuple[int, int] | None = None,
    order: str = "ABCD",
) -> Tag:
    """Return a tag with only an address and a type. It is writable except in the tables discrete and input; the device
    decides whether it accepts a write.
    """
    fixed = at is not None and at.table in ("discrete", "input")
    stores = object_ is not None and object_[0] in _STORING
    return Tag(
        name=name,
        type=kind,
        at=at,
        object=object_,
        order=order,
        poll="asked",
        access="ro" if fixed else "rw",
        unit="",
        scale=1.0,
        offset=0.0,
        values=(),
        range=None,
        counter=False,
        secret=False,
        danger=_STORING[object_[0]] if stores and object_ is not None else "",
        nonvolatile=stores,
    )
