"""An electronic data sheet (EDS or DCF, CiA 306-1) as the emulated node's object dictionary: a frozen description.

Read by code of our own: the gateway reads data sheets with the `canopen` package, and two readings of one file are
worth more than one. It must never know live values (`emulators.canopen.node_data`) nor the bus.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path, PureWindowsPath

from emulators.canopen import codec
from emulators.canopen.compact_pdo import implied_pdos
from emulators.canopen.eds_text import Note, Section, decode_file, parse_sections
from emulators.canopen.entries import ARRAY as ARRAY
from emulators.canopen.entries import DOMAIN_OBJECT as DOMAIN_OBJECT
from emulators.canopen.entries import RECORD as RECORD
from emulators.canopen.entries import VAR as VAR
from emulators.canopen.entries import DictionaryObject as DictionaryObject
from emulators.canopen.entries import Entry as Entry
from emulators.canopen.entries import Key as Key
from gateway.core.errors import FileInvalid

_DEFTYPE, _DEFSTRUCT = 0x05, 0x06
_ACCESS = ("ro", "wo", "rw", "rwr", "rww", "const")
_OBJECT = re.compile(r"[0-9a-f]{1,4}")
_SUBOBJECT = re.compile(r"([0-9a-f]{1,4})sub([0-9a-f]{1,2})")
_BIT_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)
_LISTS = ("mandatoryobjects", "optionalobjects", "manufacturerobjects")
_NAMED = 4
"""Objects of a kind that a note names."""
_NODE_ID = re.compile(r"\$nodeid", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Dictionary:
    """What a device is by its data sheet. Never changed after reading, so that many nodes share one.

    `node_id` and `bit_rate` (bit/s) are what a DCF commissions, 0 for an EDS. `dummies` are the data types that an RPDO may map
    to nothing; `bit_rates` what the device can do, in bit/s, empty where the file does not say. `notes` is what was mended.
    """

    path: str
    product_name: str
    vendor_name: str
    vendor_number: int
    node_id: int
    objects: dict[int, DictionaryObject]
    dummies: frozenset[int] = field(default_factory=frozenset)
    bit_rate: int = 0
    bit_rates: frozenset[int] = field(default_factory=frozenset)
    lss: bool = False
    notes: tuple[Note, ...] = ()

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
    notes: list[Note] = []
    return parse_eds(decode_file(raw, notes), str(path), notes, Path(path).parent)


def parse_eds(text: str, path: str = "", notes: list[Note] | None = None, folder: Path | None = None) -> Dictionary:
    """The dictionary in the text of an EDS or DCF. `path` is for messages, `notes` are known already; what a DOMAIN's
    DownloadFile names is looked for in `folder`. Raises `FileInvalid`."""
    notes = [] if notes is None else notes
    sections = parse_sections(text, path, notes)
    objects: dict[int, DictionaryObject] = {}
    for name, section in sections.items():
        # Short names such as [A0] describe data types, not objects that a client can reach.
        if _OBJECT.fullmatch(name) and len(name) == 4:
            found = _read_object(int(name, 16), section, sections)
            if found is not None:
                objects[found.index] = found
    _read_subobjects(sections, objects)
    _fill_domains(sections, objects, folder)
    if not objects:
        raise FileInvalid("a data sheet without objects", path=path, expected="sections such as [1000]")
    info = sections.get("deviceinfo", Section("DeviceInfo", 0, path, notes=notes))
    objects.update(implied_pdos(info, objects))
    _check_lists(sections, objects)
    commissioning = _commissioning(sections)
    return Dictionary(
        path=path,
        product_name=info.text("ProductName"),
        vendor_name=info.text("VendorName"),
        vendor_number=info.number("VendorNumber", 0),
        node_id=_in_range(commissioning, "NodeID", 127) if commissioning else 0,
        objects=objects,
        dummies=_read_dummies(sections.get("dummyusage")),
        bit_rate=_in_range(commissioning, "Baudrate", 1000) * 1000 if commissioning else 0,
        bit_rates=frozenset(1000 * rate for rate in _BIT_RATES if info.number(f"BaudRate_{rate}", 0)),
        lss=bool(info.number("LSS_Supported", 0)),
        notes=tuple(sorted(notes, key=lambda note: note.line)),
    )


def _commissioning(sections: dict[str, Section]) -> Section | None:
    """A DCF's section, which the standard spells with one m; tools write it both ways."""
    correct = sections.get("devicecommissioning")
    if correct is not None and "devicecomissioning" not in sections:
        correct.note("[DeviceCommissioning] taken as [DeviceComissioning], as CiA 306 spells it")
    return sections.get("devicecomissioning") or correct


def _in_range(section: Section, key: str, most: int) -> int:
    number = section.number(key, 0)
    if not 0 <= number <= most:
        raise section.error(f"{key} of [{section.name}]", key, expected=f"1 to {most}", got=str(number))
    return number


def _check_lists(sections: dict[str, Section], objects: dict[int, DictionaryObject]) -> None:
    """What the lists of objects and the counts of subindices say otherwise than the sections is noted; sections count."""
    listed: set[int] = set()
    for name in _LISTS:
        section = sections.get(name)
        for key in section.values if section else ():
            if section is not None and key.isdigit():
                index = section.number(key)
                listed.add(index)
                if index not in objects and f"{index:x}".zfill(4) not in sections:
                    section.note(f"object {index:04X}h is listed in [{section.name}] and not described", key)
    unlisted = [index for index in objects if listed and index not in listed and f"{index:04x}" in sections]
    if unlisted:
        names = ", ".join(f"{index:04X}h" for index in unlisted[:_NAMED]) + (", ..." if len(unlisted) > _NAMED else "")
        sections[f"{unlisted[0]:04x}"].note(f"{len(unlisted)} objects are described and in no list: {names}")
    for index, found in objects.items():
        own = sections.get(f"{index:04x}")
        if own is None:
            continue
        told = own.number("SubNumber", 0)
        if told and not own.number("CompactSubObj", 0) and found.kind in (ARRAY, RECORD) and told != len(found.entries):
            own.note(f"SubNumber of [{own.name}] is {told}, {len(found.entries)} are described", "SubNumber")


def _fill_domains(sections: dict[str, Section], objects: dict[int, DictionaryObject], folder: Path | None) -> None:
    """A DOMAIN holds what a DCF would download to it (CiA 306, 4.7.3). A file that is not there is no reason to refuse: noted."""
    for found in objects.values():
        for sub, entry in found.entries.items():
            section = sections.get(f"{found.index:04x}sub{sub:x}") or sections.get(f"{found.index:04x}")
            if section is None or entry.data_type != codec.DOMAIN:
                continue
            if section.text("UploadFile"):
                section.note(f"UploadFile of [{section.name}]: nothing is stored there", "UploadFile")
            name = section.text("DownloadFile")
            if not name:
                continue
            try:
                if folder is None:
                    raise FileNotFoundError
                found.entries[sub] = replace(entry, default=(folder / PureWindowsPath(name).name).read_bytes())
            except OSError:
                section.note(f"DownloadFile of [{section.name}] cannot be read, the object is empty", "DownloadFile")


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
        for listed in (names, values):
            for key in listed.values if listed else ():
                if listed and key != "nrofentries" and not (key.isdecimal() and 1 <= int(key) <= count):
                    listed.note(f"entry {key} of [{listed.name}] is left out, there are {count}", key)
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
    if not section.text("AccessType") and "accesstype" in section.values:
        section.note(f"AccessType of [{section.name}] is empty, taken as rw", "AccessType")
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
    low, high = _limit(section, "LowLimit", data_type), _limit(section, "HighLimit", data_type)
    if low is not None and high is not None and low > high:
        section.note(f"LowLimit of [{section.name}] is above its HighLimit, both are left out", "LowLimit")
        low = high = None
    return Entry(
        index=index,
        subindex=subindex,
        name=name,
        data_type=data_type,
        access=access,
        mappable=section.number("PDOMapping", 0) != 0,
        default=default,
        node_relative=relative,
        low=low,
        high=high,
    )


def _basic_type(section: Section, sections: dict[str, Section]) -> int:
    """The entry's basic data type; a type that the file defines itself is followed once, an unknown one is opaque."""
    if section.number("ObjectType", VAR) == DOMAIN_OBJECT:
        return codec.DOMAIN
    data_type = section.number("DataType")
    if data_type <= 0x1B:
        return data_type
    defined = sections.get(f"{data_type:x}sub1")
    if defined is None:
        section.note(f"DataType {data_type:04X}h of [{section.name}] is not described, taken as DOMAIN", "DataType")
        return codec.DOMAIN
    return defined.number("DefaultValue", codec.DOMAIN)


def _limit(section: Section, key: str, data_type: int) -> int | float | None:
    text = section.text(key)
    if not text or not codec.is_number(data_type) or _NODE_ID.search(text):
        return None
    try:
        return codec.decode(data_type, codec.encode_text(data_type, text))
    except ValueError:
        raise section.error(f"{key} of [{section.name}]", key, expected="a number of its type", got=text) from None
