"""An electronic data sheet (EDS or DCF, CiA 306-1) as the emulated node's object dictionary: a frozen description.

Read by code of our own: the gateway reads data sheets with the `canopen` package, and two readings of one file are
worth more than one. It must never know live values (`emulators.canopen.node_data`) nor the bus.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from emulators.canopen import codec
from emulators.canopen.eds_text import Section, decode_file, parse_sections
from gateway.core.errors import FileInvalid

Key = tuple[int, int]
"""(index, subindex)."""

VAR, ARRAY, RECORD, DOMAIN_OBJECT = 0x07, 0x08, 0x09, 0x02
_DEFTYPE, _DEFSTRUCT = 0x05, 0x06
_ACCESS = ("ro", "wo", "rw", "rwr", "rww", "const")
_OBJECT = re.compile(r"[0-9a-f]{1,4}")
_SUBOBJECT = re.compile(r"([0-9a-f]{1,4})sub([0-9a-f]{1,2})")
_NODE_ID = re.compile(r"\$nodeid", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Entry:
    """One subindex. `default` is on-wire bytes; with `node_relative` the node id is added to it.

    `size` is the value's length in bytes, None where every value has its own. `low` and `high` are inclusive.
    """

    index: int
    subindex: int
    name: str
    data_type: int
    access: str
    mappable: bool
    default: bytes
    node_relative: bool = False
    low: int | float | None = None
    high: int | float | None = None

    @property
    def key(self) -> Key:
        return self.index, self.subindex

    @property
    def size(self) -> int | None:
        return codec.size_bytes(self.data_type)

    @property
    def readable(self) -> bool:
        return self.access != "wo"

    @property
    def writable(self) -> bool:
        return self.access in ("rw", "rwr", "rww", "wo")

    def initial(self, node_id: int) -> bytes:
        """The default value of a node with this id."""
        if not self.node_relative:
            return self.default
        return codec.encode(self.data_type, int(codec.decode(self.data_type, self.default)) + node_id)


@dataclass(frozen=True, slots=True)
class DictionaryObject:
    """One index: a VAR has subindex 0 only; an ARRAY or RECORD has the subindices that the data sheet lists."""

    index: int
    name: str
    kind: int
    entries: dict[int, Entry]


@dataclass(frozen=True, slots=True)
class Dictionary:
    """What a device is by its data sheet. Never changed after reading, so that many nodes share one.

    `node_id` is what a DCF commissions, 0 for an EDS. `dummies` are the data types that an RPDO may map to nothing.
    """

    path: str
    product_name: str
    vendor_name: str
    vendor_number: int
    node_id: int
    objects: dict[int, DictionaryObject]
    dummies: frozenset[int] = field(default_factory=frozenset)

    def __contains__(self, index: object) -> bool:
        return index in self.objects

    def entry(self, index: int, subindex: int) -> Entry | None:
        """The entry, or None when there is none."""
        found = self.objects.get(index)
        return found.entries.get(subindex) if found else None

    def entries(self) -> Iterator[Entry]:
        """All entries by index and subindex."""
        for index in sorted(self.objects):
            yield from (self.objects[index].entries[sub] for sub in sorted(self.objects[index].entries))


def load_eds(path: str | Path) -> Dictionary:
    """The dictionary in a file. Raises `FileInvalid` with path and line."""
    try:
        raw = Path(path).read_bytes()
    except OSError as e:
        raise FileInvalid("the data sheet cannot be read", path=str(path), got=e.strerror or str(e)) from e
    return parse_eds(decode_file(raw), str(path))


def parse_eds(text: str, path: str = "") -> Dictionary:
    """The dictionary in the text of an EDS or DCF. `path` is for messages. Raises `FileInvalid`."""
    sections = parse_sections(text, path)
    objects: dict[int, DictionaryObject] = {}
    for name, section in sections.items():
        # Short names such as [A0] describe data types, not objects that a client can reach.
        if _OBJECT.fullmatch(name) and len(name) == 4:
            found = _read_object(int(name, 16), section, sections)
            if found is not None:
                objects[found.index] = found
    _read_subobjects(sections, objects)
    if not objects:
        raise FileInvalid("a data sheet without objects", path=path, expected="sections such as [1000]")
    info = sections.get("deviceinfo", Section("DeviceInfo", 0, path))
    _refuse_implied_pdos(info, objects)
    commissioning = sections.get("devicecomissioning") or sections.get("devicecommissioning")
    return Dictionary(
        path=path,
        product_name=info.text("ProductName"),
        vendor_name=info.text("VendorName"),
        vendor_number=info.number("VendorNumber", 0),
        node_id=commissioning.number("NodeID", 0) if commissioning else 0,
        objects=objects,
        dummies=_read_dummies(sections.get("dummyusage")),
    )


def _refuse_implied_pdos(info: Section, objects: dict[int, DictionaryObject]) -> None:
    """A file may describe PDOs by the CompactPDO mask alone; a node without its PDOs would be a silent half."""
    if not info.number("CompactPDO", 0):
        return
    for key, first in (("NrOfRXPDO", 0x1400), ("NrOfTXPDO", 0x1800)):
        listed = sum(first <= index < first + 0x200 for index in objects)
        if listed < info.number(key, 0):
            raise info.error(
                "PDOs that are described by CompactPDO only",
                "CompactPDO",
                expected=f"{info.number(key, 0)} sections from [{first:X}] on",
                got=str(listed),
            )


def _read_dummies(section: Section | None) -> frozenset[int]:
    if section is None:
        return frozenset()
    return frozenset(t for t in range(1, 8) if section.number(f"Dummy{t:04X}", 0) == 1)


def _read_object(index: int, section: Section, sections: dict[str, Section]) -> DictionaryObject | None:
    kind = section.number("ObjectType", VAR)
    name = section.text("ParameterName", f"{index:04X}h")
    if kind in (_DEFTYPE, _DEFSTRUCT):
        return None  # a data type's definition is no object that holds a value
    if kind in (VAR, DOMAIN_OBJECT):
        return DictionaryObject(index, name, kind, {0: _read_entry(index, 0, section, sections, name)})
    if kind not in (ARRAY, RECORD):
        raise section.error(f"object {index:04X}h is of an unknown kind", "ObjectType", expected="2, 7, 8 or 9")
    entries: dict[int, Entry] = {}
    count = section.number("CompactSubObj", 0)
    if not 0 <= count <= 254:
        raise section.error("CompactSubObj", "CompactSubObj", expected="0 to 254", got=str(count))
    if count:
        entries[0] = Entry(index, 0, "Highest subindex supported", 0x05, "ro", False, bytes([count]))
        names = sections.get(f"{index:04x}name")
        values = sections.get(f"{index:04x}value")
        for sub in range(1, count + 1):
            label = names.text(str(sub), f"{name}{sub}") if names else f"{name}{sub}"
            text = values.text(str(sub)) if values else ""
            entries[sub] = _read_entry(index, sub, section, sections, label, text)
    return DictionaryObject(index, name, kind, entries)


def _read_subobjects(sections: dict[str, Section], objects: dict[int, DictionaryObject]) -> None:
    for name, section in sections.items():
        match = _SUBOBJECT.fullmatch(name)
        if match is None or len(match.group(1)) != 4:
            continue
        index, sub = int(match.group(1), 16), int(match.group(2), 16)
        parent = objects.get(index)
        if parent is None:
            raise section.error(
                f"a subindex of an object that is not there: [{section.name}]", expected=f"[{index:04X}]"
            )
        if parent.kind in (ARRAY, RECORD):
            label = section.text("ParameterName", f"{parent.name}{sub}")
            parent.entries[sub] = _read_entry(index, sub, section, sections, label)


def _read_entry(
    index: int, subindex: int, section: Section, sections: dict[str, Section], name: str, value_text: str = ""
) -> Entry:
    data_type = _basic_type(section, sections)
    access = section.text("AccessType", "rw").lower()
    if access not in _ACCESS:
        raise section.error(f"AccessType of [{section.name}]", "AccessType", expected=", ".join(_ACCESS), got=access)
    key = "ParameterValue" if section.text("ParameterValue") else "DefaultValue"
    text = value_text or section.text(key)
    relative = bool(_NODE_ID.search(text)) and codec.is_number(data_type)
    if relative:
        text = _NODE_ID.sub("", text).replace(" ", "").strip("+") or "0"
    try:
        default = codec.encode_text(data_type, text)
    except ValueError:
        raise section.error(
            f"{key} of [{section.name}]", key, expected=f"a value of data type {data_type:04X}h", got=text
        ) from None
    return Entry(
        index=index,
        subindex=subindex,
        name=name,
        data_type=data_type,
        access=access,
        mappable=section.number("PDOMapping", 0) != 0,
        default=default,
        node_relative=relative,
        low=_limit(section, "LowLimit", data_type),
        high=_limit(section, "HighLimit", data_type),
    )


def _basic_type(section: Section, sections: dict[str, Section]) -> int:
    """The entry's basic data type; a type that the file defines itself is followed once, an unknown one is opaque."""
    if section.number("ObjectType", VAR) == DOMAIN_OBJECT:
        return codec.DOMAIN
    data_type = section.number("DataType")
    if data_type <= 0x1B:
        return data_type
    defined = sections.get(f"{data_type:x}sub1")
    return defined.number("DefaultValue", codec.DOMAIN) if defined else codec.DOMAIN


def _limit(section: Section, key: str, data_type: int) -> int | float | None:
    text = section.text(key)
    if not text or not codec.is_number(data_type) or _NODE_ID.search(text):
        return None
    try:
        return codec.decode(data_type, codec.encode_text(data_type, text))
    except ValueError:
        raise section.error(f"{key} of [{section.name}]", key, expected="a number of its type", got=text) from None
