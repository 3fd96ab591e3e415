"""An electronic data sheet (EDS or DCF, CiA 306-1) as the emulated node's object dictionary: a frozen description.

It has its own parser, because the gateway reads data sheets with the `canopen` package, and two independent readers reveal each
other's mistakes. It must not depend on live values (`fieldtwin.emulators.canopen.node_data`) or the bus.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path, PureWindowsPath

from fieldtwin.emulators.canopen.eds import codec
from fieldtwin.emulators.canopen.eds.compact_pdo import implied_pdos
from fieldtwin.emulators.canopen.eds.entries import ARRAY as ARRAY
from fieldtwin.emulators.canopen.eds.entries import DOMAIN_OBJECT as DOMAIN_OBJECT
from fieldtwin.emulators.canopen.eds.entries import RECORD as RECORD
from fieldtwin.emulators.canopen.eds.entries import VAR as VAR
from fieldtwin.emulators.canopen.eds.entries import DictionaryObject as DictionaryObject
from fieldtwin.emulators.canopen.eds.entries import Key as Key
from fieldtwin.emulators.canopen.eds.entries import SubindexEntry as SubindexEntry
from fieldtwin.emulators.canopen.eds.text import Note, Section, decode_file, parse_sections
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.input_file import read_input

MAX_EDS_BYTES = 8 * 1024 * 1024
"""A larger EDS or DCF file is a mistake; the largest known one has 2 MB."""
MAX_DOMAIN_BYTES = 16 * 1024 * 1024
"""Maximum size of a file that a DOMAIN object names as its content."""
_ACCESS = ("ro", "wo", "rw", "rwr", "rww", "const")
_OBJECT = re.compile(r"[0-9a-f]{1,4}")
_VALUES = re.compile(r"[0-9a-f]{4}value")
_SUBOBJECT = re.compile(r"([0-9a-f]{1,4})sub([0-9a-f]{1,2})")
_HOLDS_NO_VALUE = (0x05, 0x06)
"""Object types that define a data type and hold no value: DEFTYPE and DEFSTRUCT."""
_RESERVED_TYPES = (0x00, 0x0E, 0x17)
_BIT_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)
_LISTS = ("mandatoryobjects", "optionalobjects", "manufacturerobjects")
_NAMED = 4
"""The largest number of objects of one kind that a note names."""
_NODE_ID = re.compile(r"\$nodeid", re.IGNORECASE)
_RELATIVE = re.compile(r"\$nodeid(?:\+([0-9a-fx]+))?|([0-9a-fx]+)\+\$nodeid", re.IGNORECASE)
"""``$NODEID``, ``$NODEID+0x180`` and ``0x180+$NODEID`` (CiA 306-1, 4.6.3.2), without spaces."""
_HIGHEST_NODE_ID = 127
_FIRST_OBJECT = 0x1000
"""Lower indices define data types (CiA 301, 7.4.1), which clients do not read."""
_LAST_TYPE = 0x1B


@dataclass(frozen=True, slots=True)
class Dictionary:
    """A device as its data sheet describes it. It never changes after reading, so that many nodes can share it.

    `node_id` and `bit_rate` (bit/s) come from a DCF's commissioning section; they are 0 for an EDS. `dummies` are the data types
    that an RPDO may map without an object; `bit_rates` are those that the device supports, in bit/s, empty if the file
    does not list them. `notes` lists the corrections made while reading.
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

    def entry(self, index: int, subindex: int) -> SubindexEntry | None:
        """Return the entry, or None if it does not exist."""
        found = self.objects.get(index)
        return found.entries.get(subindex) if found else None

    def entries(self) -> Iterator[SubindexEntry]:
        """Return all entries, sorted by index and subindex."""
        for index in sorted(self.objects):
            yield from (self.objects[index].entries[sub] for sub in sorted(self.objects[index].entries))


def load_eds(path: str | Path, *, parameter_values: bool = True) -> Dictionary:
    """Return the dictionary in a file. Raises `FileInvalid` with path and line.

    Without `parameter_values` the node starts with the DefaultValues, like a node that no DCF has configured.
    """
    try:
        raw = read_input(Path(path), MAX_EDS_BYTES)
    except OSError as e:
        raise FileInvalid("the data sheet cannot be read", path=str(path), got=e.strerror or str(e)) from e
    notes: list[Note] = []
    return parse_eds(decode_file(raw, notes), str(path), notes, Path(path).parent, parameter_values=parameter_values)


def parse_eds(
    text: str,
    path: str = "",
    notes: list[Note] | None = None,
    folder: Path | None = None,
    *,
    parameter_values: bool = True,
) -> Dictionary:
    """Return the dictionary in the text of an EDS or DCF. Raises `FileInvalid`.

    `path` is used in messages. `notes` are corrections that were made before. A DOMAIN's DownloadFile is searched in `folder`.
    `parameter_values` has the meaning that it has in `load_eds`.
    """
    notes = [] if notes is None else notes
    sections = parse_sections(text, path, notes)
    if not parameter_values:
        _forget_parameter_values(sections)
    objects: dict[int, DictionaryObject] = {}
    for name, section in sections.items():
        # Short names such as [A0] describe data types, not objects that a client can access.
        if _OBJECT.fullmatch(name) and len(name) == 4 and int(name, 16) >= _FIRST_OBJECT:
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
        vendor_number=info.count("VendorNumber"),
        node_id=_in_range(commissioning, "NodeID", 127) if commissioning else 0,
        objects=objects,
        dummies=_read_dummies(sections.get("dummyusage")),
        bit_rate=_in_range(commissioning, "Baudrate", 1000) * 1000 if commissioning else 0,
        bit_rates=frozenset(1000 * rate for rate in _BIT_RATES if info.count(f"BaudRate_{rate}")),
        lss=bool(info.count("LSS_Supported")),
        notes=tuple(sorted(notes, key=lambda note: note.line)),
    )


def _forget_parameter_values(sections: dict[str, Section]) -> None:
    """Remove what a DCF adds to an EDS: ParameterValues, DownloadFiles and the values of compact arrays."""
    for name in [name for name in sections if _VALUES.fullmatch(name)]:
        del sections[name]
    for section in sections.values():
        for key in ("parametervalue", "downloadfile"):
            section.values.pop(key, None)


def _commissioning(sections: dict[str, Section]) -> Section | None:
    """Return a DCF's commissioning section. The standard spells it with one m; tools use both spellings."""
    correct = sections.get("devicecommissioning")
    if correct is not None and "devicecomissioning" not in sections:
        correct.note("[DeviceCommissioning] taken as [DeviceComissioning], as CiA 306 spells it")
    return sections.get("devicecomissioning") or correct


def _in_range(section: Section, key: str, most: int) -> int:
    number = section.count(key)
    if 0 <= number <= most:
        return number
    section.note(f"{key} of [{section.name}] is not 1 to {most}, left out", key)
    return 0


def _check_lists(sections: dict[str, Section], objects: dict[int, DictionaryObject]) -> None:
    """Add notes where the lists of objects and the counts of subindices differ from the sections. The sections are used."""
    listed: set[int] = set()
    for name in _LISTS:
        section = sections.get(name)
        for key in section.values if section else ():
            if section is not None and key.isdigit():
                index = section.count(key)
                listed.add(index)
                if index not in objects and f"{index:x}".zfill(4) not in sections:
                    section.note(f"object {index:04X}h is listed in [{section.name}] and not described", key)
    unlisted = [index for index in objects if listed and index not in listed and f"{index:04x}" in sections]
    if unlisted:
        names = ", ".join(f"{index:04X}h" for index in unlisted[:_NAMED]) + (", ..." if len(unlisted) > _NAMED else "")
        sections[f"{unlisted[0]:04x}"].note(f"{len(unlisted)} objects are described, but not listed: {names}")
    for index, found in objects.items():
        own = sections.get(f"{index:04x}")
        if own is None:
            continue
        stated = own.count("SubNumber")
        if (
            stated
            and not own.number("CompactSubObj", 0)
            and found.kind in (ARRAY, RECORD)
            and stated != len(found.entries)
        ):
            own.note(f"SubNumber of [{own.name}] is {stated}, {len(found.entries)} are described", "SubNumber")


def _fill_domains(sections: dict[str, Section], objects: dict[int, DictionaryObject], folder: Path | None) -> None:
    """Fill each DOMAIN with the data that a DCF would download to it (CiA 306, 4.7.3).

    A missing file is noted, not refused.
    """
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
                found.entries[sub] = replace(
                    entry, default=read_input(folder / PureWindowsPath(name).name, MAX_DOMAIN_BYTES), configured=True
                )
            except OSError:
                section.note(f"DownloadFile of [{section.name}] cannot be read, the object is empty", "DownloadFile")


def _read_dummies(section: Section | None) -> frozenset[int]:
    if section is None:
        return frozenset()
    return frozenset(t for t in range(1, 8) if section.count(f"Dummy{t:04X}") == 1)


def _read_object(index: int, section: Section, sections: dict[str, Section]) -> DictionaryObject | None:
    kind = section.number("ObjectType", VAR)
    name = section.text("ParameterName", f"{index:04X}h")
    if kind in (VAR, DOMAIN_OBJECT):
        return DictionaryObject(index, name, kind, {0: _read_entry(index, 0, section, sections, name)})
    if kind not in (ARRAY, RECORD):
        if kind not in _HOLDS_NO_VALUE:
            section.note(f"ObjectType {kind:X}h of [{section.name}] is unknown, the object is left out", "ObjectType")
        return None
    entries: dict[int, SubindexEntry] = {}
    count = section.number("CompactSubObj", 0)
    if count == 255:  # the highest subindex is 254 (CiA 306, 4.7.2); several public files count one more
        section.note(f"CompactSubObj 255 of [{section.name}] is taken as 254, the highest subindex", "CompactSubObj")
        count = 254
    if not 0 <= count <= 254:
        raise section.error("CompactSubObj", "CompactSubObj", expected="0 to 254", got=str(count))
    if count:
        entries[0] = SubindexEntry(index, 0, "Highest subindex supported", 0x05, "ro", False, bytes([count]))
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
            if f"{index:04x}" not in sections:
                section.note(f"[{section.name}] is left out, there is no [{index:04X}]")
        elif parent.kind not in (ARRAY, RECORD):
            section.note(f"[{section.name}] is left out, [{index:04X}] is a single variable")
        else:
            label = section.text("ParameterName", f"{parent.name}{sub}")
            parent.entries[sub] = _read_entry(index, sub, section, sections, label)


def _read_entry(
    index: int, subindex: int, section: Section, sections: dict[str, Section], name: str, value_text: str = ""
) -> SubindexEntry:
    data_type = _basic_type(section, sections)
    if not section.text("AccessType"):
        section.note(f"AccessType of [{section.name}] is missing, taken as rw", "AccessType")
    if not section.text("ParameterName"):
        section.note(f"ParameterName of [{section.name}] is missing", "ParameterName")
    access = section.text("AccessType", "rw").lower()
    if access not in _ACCESS:
        raise section.error(f"AccessType of [{section.name}]", "AccessType", expected=", ".join(_ACCESS), got=access)
    default, relative, configured = _read_default(section, data_type, value_text)
    low, high = _limit(section, "LowLimit", data_type), _limit(section, "HighLimit", data_type)
    if low is not None and high is not None and low > high:
        section.note(f"LowLimit of [{section.name}] is above its HighLimit, both are left out", "LowLimit")
        low = high = None
    return SubindexEntry(
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
        configured=configured,
    )


def _read_default(section: Section, data_type: int, value_text: str) -> tuple[bytes, bool, bool]:
    """Return the initial bytes of the object, whether the node ID is added to them, and whether a DCF sets them.

    A value that does not fit its data type (a text in a DOMAIN, 300 in an UNSIGNED8) is noted and replaced: a ParameterValue by
    the DefaultValue, and a DefaultValue by the type's zero or the empty string.
    """
    texts = [("value", value_text), *((key, section.text(key)) for key in ("ParameterValue", "DefaultValue"))]
    for key, text in texts:
        if not text:
            continue
        try:
            return *_value(data_type, text), key != "DefaultValue"
        except ValueError:
            section.note(f"{key} of [{section.name}] is not a value of data type {data_type:04X}h: {text[:40]}", key)
    return codec.encode_text(data_type, ""), False, False


def _value(data_type: int, text: str) -> tuple[bytes, bool]:
    """Return the bytes for a text, and whether the node ID is added to them. Raises `ValueError`."""
    if not codec.is_integer(data_type) or not _NODE_ID.search(text):
        return codec.encode_text(data_type, text), False
    match = _RELATIVE.fullmatch(text.replace(" ", ""))
    if match is None:
        raise ValueError("neither a number, nor a number and the node id")
    raw = codec.encode_text(data_type, match[1] or match[2] or "0")
    codec.encode(
        data_type, int(codec.decode(data_type, raw)) + _HIGHEST_NODE_ID
    )  # the type must hold it for every node ID
    return raw, True


def _basic_type(section: Section, sections: dict[str, Section]) -> int:
    """Return the entry's basic data type. A type that the file defines is resolved once; an unknown type is opaque."""
    if section.number("ObjectType", VAR) == DOMAIN_OBJECT:
        return codec.DOMAIN
    data_type = section.number("DataType")
    defined = sections.get(f"{data_type:x}sub1")
    if data_type > _LAST_TYPE and defined is not None:
        data_type = defined.count("DefaultValue")
    if 0 < data_type <= _LAST_TYPE and data_type not in _RESERVED_TYPES:
        return data_type
    section.note(f"DataType {data_type:04X}h of [{section.name}] is not described, taken as DOMAIN", "DataType")
    return codec.DOMAIN


def _limit(section: Section, key: str, data_type: int) -> int | float | None:
    text = section.text(key)
    if not text or not codec.is_number(data_type) or _NODE_ID.search(text):
        return None
    try:
        limit = codec.decode(data_type, codec.encode_text(data_type, text))
        if math.isnan(limit):
            raise ValueError("no value is above or below it")
        return limit
    except ValueError:
        section.note(f"{key} of [{section.name}] is not a number of its type, left out: {text[:40]}", key)
        return None
