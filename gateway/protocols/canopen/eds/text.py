"""EDS and DCF files as text (CiA 306): sections and keys with their lines, and the repairs that real files need.

Vendors' files leave numbers empty, write octal numbers, vary the case of keys, put sub-objects before their object and use the
encoding of the vendor's editor. This module accepts such files and lists its repairs. It refuses ambiguous content, with file,
section and key. It produces the repaired text; `values` reads the values in it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.protocols.canopen.eds.datatypes import DataType

MAX_BYTES = 16 * 1024 * 1024
"""The largest accepted file. Every EDS is much smaller, so a larger file is not an EDS."""

_OBJECT = re.compile(r"^([0-9A-F]{4})(?:(SUB)([0-9A-F]{1,2})|(NAME|VALUE|DENOTATION))?$", re.IGNORECASE)
_DOMAIN = "0xF"
"""The type code of DOMAIN, as text."""
_COMMENT = re.compile(r"\s;.*$")
_HEADING = re.compile(r"\[([^\]]+)\]")
_OCTAL = re.compile(r"^0[0-7]+$")
_NUMBER = re.compile(r"^(0x[0-9a-f]+|[0-9]+)$", re.IGNORECASE)

_TEXT_KEYS = ("ParameterName", "AccessType", "DefaultValue", "ParameterValue", "LowLimit", "HighLimit")
_MORE_TEXT_KEYS = ("Factor", "Description", "Unit", "StorageLocation", "DownloadFile")
_VALUE_KEYS = frozenset({"DefaultValue", "ParameterValue", "LowLimit", "HighLimit", "DownloadFile"})
"""Keys that `values` reads; they are not passed to the `canopen` reader."""
_NUMBER_KEYS = {"ObjectType": "0x7", "DataType": "", "PDOMapping": "0", "CompactSubObj": "0", "NrOfEntries": "0"}
"""Keys that hold a number, and the default for an empty one (CiA 306, 4.6.3.2); no default if the key is required."""

_DEVICE_TEXT = ("VendorName", "ProductName", "OrderCode")
BIT_RATES_KBIT = (10, 20, 50, 125, 250, 500, 800, 1000)
"""The bit rates for which an EDS has a key, such as ``BaudRate_250`` (CiA 306-1, 4.4), in kbit/s."""
_DEVICE_ABILITIES = (
    "SimpleBootUpMaster",
    "SimpleBootUpSlave",
    "Granularity",
    "DynamicChannelsSupported",
    "GroupMessaging",
)
_DEVICE_NUMBERS = (
    *("VendorNumber", "ProductNumber", "RevisionNumber", "NrOfRXPDO", "NrOfTXPDO", "LSS_Supported"),
    *(*_DEVICE_ABILITIES, *(f"BaudRate_{kbit}" for kbit in BIT_RATES_KBIT)),
)
_COMMISSIONING_TEXT = ("NodeName",)
_COMMISSIONING_NUMBERS = ("NodeID", "Baudrate")
_AT_MOST = {"NodeID": 127, "Baudrate": 1000}
_ACCESS = ("ro", "wo", "rw", "rwr", "rww", "const")
_MOST_ENTRIES = 254
_CANONICAL = {
    key.lower(): key
    for key in (
        "UploadFile",
        *_TEXT_KEYS,
        *_MORE_TEXT_KEYS,
        *_NUMBER_KEYS,
        *_DEVICE_TEXT,
        *_DEVICE_NUMBERS,
        *_COMMISSIONING_TEXT,
        *_COMMISSIONING_NUMBERS,
    )
}


@dataclass(slots=True)
class Section:
    """One section: canonical key -> value, and the line of each key. `line` is the line of the heading."""

    name: str
    line: int
    values: dict[str, str] = field(default_factory=dict)
    lines: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class EdsText:
    """A repaired file: its sections by canonical name (``DeviceInfo``, ``1018``, ``1018sub1``, ``3004Name``)."""

    sections: dict[str, Section]
    mended: tuple[str, ...]

    def __str__(self) -> str:
        """Return the text of the repaired file: only content that concerns objects, with each object before its sub-objects."""
        blocks = []
        for name, section in self.sections.items():
            lines = [f"{key}={value}" for key, value in section.values.items() if key not in _VALUE_KEYS]
            blocks.append("\n".join([f"[{name}]", *lines]))
        return "\n\n".join(blocks) + "\n"


def decode_eds(raw: bytes, path: str = "") -> tuple[str, tuple[str, ...]]:
    """Return the text of a file and the assumptions made about its encoding.

    A byte order mark shows UTF-16 or UTF-8; otherwise the encoding is UTF-8 if the bytes are valid, else Windows-1252."""
    if len(raw) > MAX_BYTES:
        raise FileInvalid("not an EDS", path=path, expected=f"at most {MAX_BYTES} bytes", got=str(len(raw)))
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return raw.decode("utf-16", errors="replace"), ("in UTF-16",)
    try:
        return raw.decode("utf-8-sig"), ()
    except UnicodeDecodeError:
        text = raw.decode("cp1252", errors="replace")
        return text, ("not UTF-8: read as Windows-1252",)


def read_eds_text(text: str, path: str = "") -> EdsText:
    """Read and repair a text. Raises `FileInvalid` with file, line, section and key for errors that cannot be repaired."""
    mended: list[str] = []
    sections = _split(text, path, mended)
    if not any(_OBJECT.match(name) for name in sections):
        raise FileInvalid("no object in this file", path=path, expected="an EDS or DCF with sections such as [1000]")
    kept: dict[str, Section] = {}
    for name, allowed in (("DeviceInfo", (_DEVICE_TEXT, _DEVICE_NUMBERS)), ("DeviceComissioning", _commissioning())):
        section = sections.get(name, Section(name, 0))
        kept[name] = _repair_information(section, allowed, path, mended)
    for name in sorted((n for n in sections if _OBJECT.match(n) and not n.endswith("Denotation")), key=_order):
        parent = sections.get(name[:4])
        if parent is None:
            mended.append(f"[{name}]: left out, there is no [{name[:4]}]")
        elif not _holds_values(parent, path):
            if name == parent.name and _kind(parent, path) not in (0x5, 0x6):  # the definition of a data type
                mended.append(f"[{name}] ObjectType: unknown, the object is left out")
        elif name != parent.name and _is_variable(parent, path) and "CompactSubObj" not in kept[parent.name].values:
            mended.append(f"[{name}]: left out, [{parent.name}] is a single variable")
        elif name.endswith("Name"):
            _repair_names(sections[name], parent, kept, path, mended)
        elif name.endswith("Value"):
            _spell_out(sections[name], parent, kept, path, mended)
        else:
            kept[name] = _repair_object(sections[name], sections, path, mended)
    return EdsText(kept, tuple(mended))


def invalid(message: str, section: Section, key: str, path: str, *, expected: str, got: str = "") -> FileInvalid:
    """Return a `FileInvalid` for a key of a section."""
    line = section.lines.get(key, section.line)
    return FileInvalid(f"[{section.name}] {key}: {message}", path=path, line=line, expected=expected, got=got)


def _commissioning() -> tuple[tuple[str, ...], tuple[str, ...]]:
    return _COMMISSIONING_TEXT, _COMMISSIONING_NUMBERS


def _order(name: str) -> tuple[int, int, int]:
    """Return the sort key of a section: first the object, then its sub-objects, its names and its values."""
    rank = {"Name": 1, "Value": 2}.get(name[4:], 0)
    return int(name[:4], 16), rank, -1 if rank or len(name) == 4 else int(name[7:], 16)


def _canonical_section(name: str) -> str:
    match = _OBJECT.match(name)
    if match is None:
        known = {"deviceinfo": "DeviceInfo", "devicecomissioning": "DeviceComissioning"}
        known["devicecommissioning"] = "DeviceComissioning"  # the standard misspells it, some vendors do not
        return known.get(name.lower(), name)
    index = match[1].upper()
    if match[4]:
        return index + match[4].capitalize()
    return f"{index}sub{int(match[3], 16):X}" if match[2] else index


def _split(text: str, path: str, mended: list[str]) -> dict[str, Section]:
    """Return the sections with their keys. A repeated key or object is refused unless the repetition is identical."""
    sections: dict[str, Section] = {}
    current: Section | None = None
    for number, raw in enumerate(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), 1):
        line = _COMMENT.sub("", raw).strip()
        if not line or line[0] in ";#":
            continue
        if line[0] == "[":
            heading = _HEADING.match(line)
            if heading is None:
                raise FileInvalid("a section without its bracket", path=path, line=number, expected="[...]", got=line)
            current = Section(_canonical_section(heading[1].strip()), number)
            if current.name in sections and _OBJECT.match(current.name):
                before = sections[current.name].line
                raise FileInvalid(f"[{current.name}] occurs twice", path=path, line=number, got=f"also line {before}")
            if current.name in sections:
                mended.append(f"[{current.name}]: occurs twice; the last one is used")
            sections[current.name] = current
            continue
        key, equals, value = line.partition("=")
        if current is None or not equals:
            if current is not None and not _OBJECT.match(current.name):
                continue  # free text in a comment section
            raise FileInvalid(
                "neither section nor key", path=path, line=number, expected="[...] or KEY=VALUE", got=line[:60]
            )
        _put(current, key.strip(), value.strip(), number, path, mended)
    return sections


def _put(section: Section, written: str, value: str, line: int, path: str, mended: list[str]) -> None:
    key = _CANONICAL.get(written.lower(), written)
    if key in section.values and _OBJECT.match(section.name):
        if section.values[key] != value:
            raise FileInvalid(
                f"[{section.name}] {key} occurs twice", path=path, line=line, got=f"also line {section.lines[key]}"
            )
        mended.append(f"[{section.name}] {key}: occurs twice")
    section.values[key], section.lines[key] = value, line


def _number(section: Section, key: str, if_empty: str, path: str, mended: list[str]) -> str:
    """Return a number in the notation that `canopen` reads: decimal, or with 0x.

    Octal numbers (with a leading 0 in CiA 306) are rewritten, and an empty number becomes the default."""
    value = section.values[key].replace(" ", "")
    if not value:
        if not if_empty:
            raise invalid("is empty", section, key, path, expected="a number")
        mended.append(f"[{section.name}] {key}: empty, read as {if_empty}")
        return if_empty
    if _OCTAL.match(value):
        return str(int(value, 8))
    if not _NUMBER.match(value) or (len(value) > 1 and value[0] == "0" and value[1] in "0123456789"):
        raise invalid("cannot be read", section, key, path, expected="a number", got=repr(value))
    return value


def _repair_information(
    section: Section, allowed: tuple[tuple[str, ...], tuple[str, ...]], path: str, mended: list[str]
) -> Section:
    """Return the section [DeviceInfo] or [DeviceComissioning] with only the keys that are needed."""
    texts, numbers = allowed
    kept = Section(section.name, section.line)
    for key in section.values:
        if key in texts:
            kept.values[key] = section.values[key]
        elif key in numbers and (section.values[key] or key not in _COMMISSIONING_NUMBERS):
            _repair_count(section, key, kept, path, mended)
        elif key.lower() == "compactpdo" and section.values[key] not in ("", "0", "0x0", "0x00"):
            mended.append("[DeviceInfo] CompactPDO: PDO parameters that the file leaves out are not made up")
    return kept


def _repair_count(section: Section, key: str, kept: Section, path: str, mended: list[str]) -> None:
    """Copy a number that describes the whole device. An impossible number is left out, because no object depends on it."""
    try:
        number = int(_number(section, key, "0", path, mended), 0)
    except FileInvalid:
        mended.append(f"[{section.name}] {key}: not a number, left out")
        return
    if number > _AT_MOST.get(key, number):
        mended.append(f"[{section.name}] {key}: not 1 to {_AT_MOST[key]}, left out")
        return
    kept.values[key] = str(number)


def _kind(section: Section, path: str) -> int:
    """Return the ObjectType, which is 7 (VAR) if the section does not have one."""
    return int(_number(section, "ObjectType", "0x7", path, []), 0) if "ObjectType" in section.values else 7


def _holds_values(section: Section, path: str) -> bool:
    """Return whether the object can hold values: whether it is a DOMAIN, VAR, ARRAY or RECORD (CiA 306-1, 4.6.3.2)."""
    return _kind(section, path) in (0x2, 0x7, 0x8, 0x9)


def _data_type(section: Section, kept: Section, sections: dict[str, Section], path: str, mended: list[str]) -> str:
    """Return the basic data type of a value as text; a type that is not defined becomes DOMAIN.

    CANFestival's editor defines additional types: the DefaultValue of ``[A0sub1]`` is the basic data type of its type A0h.
    """
    if _kind(section, path) == 0x2:
        return _DOMAIN
    if not kept.values.get("DataType"):
        raise invalid("is missing", section, "DataType", path, expected="a number")
    code = int(kept.values["DataType"], 0)
    known = {int(kind) for kind in DataType}
    defined = sections.get(f"{code:X}sub1", Section("", 0)).values.get("DefaultValue", "")
    if code > max(known) and _NUMBER.match(defined):
        code = int(defined, 16 if defined.lower().startswith("0x") else 10)
    if code in known:
        return hex(code)
    mended.append(f"[{section.name}] DataType: {kept.values['DataType']} is not described, read as DOMAIN")
    return _DOMAIN


def _repair_object(section: Section, sections: dict[str, Section], path: str, mended: list[str]) -> Section:
    """Return the section of an object or sub-object with all keys that the strict reader of `canopen` requires."""
    kept = Section(section.name, section.line, lines=section.lines)
    for key, value in section.values.items():
        if key in _NUMBER_KEYS:
            if key == "DataType" and not value and (_kind(section, path) == 0x2 or not _is_variable(section, path)):
                continue  # the data type of a record means nothing, and a DOMAIN needs none
            kept.values[key] = _number(section, key, _NUMBER_KEYS[key], path, mended)
        elif key in _TEXT_KEYS or key in _MORE_TEXT_KEYS:
            kept.values[key] = value
        elif key == "UploadFile" and value:
            mended.append(f"[{section.name}] UploadFile: nothing is stored there")
    if not int(kept.values.get("CompactSubObj", "0"), 0):
        kept.values.pop("CompactSubObj", None)  # `canopen` takes an object that has this key for a compact array
    if not kept.values.get("ParameterName"):
        kept.values["ParameterName"] = f"{section.name[:4]}h"
        mended.append(f"[{section.name}] ParameterName: missing")
    if _is_variable(kept, path):
        kept.values["DataType"] = _data_type(section, kept, sections, path, mended)
        kept.values["AccessType"] = _access(section, path, mended)
    if "CompactSubObj" in kept.values:
        if int(kept.values["CompactSubObj"], 0) == _MOST_ENTRIES + 1:
            kept.values["CompactSubObj"] = str(_MOST_ENTRIES)
            mended.append(
                f"[{section.name}] CompactSubObj: {_MOST_ENTRIES + 1}, taken as {_MOST_ENTRIES}, the highest subindex"
            )
        if int(kept.values["CompactSubObj"], 0) > _MOST_ENTRIES:
            raise invalid("is too large", section, "CompactSubObj", path, expected=f"0 to {_MOST_ENTRIES}")
        kept.values["ObjectType"] = "0x8"  # `canopen` knows compact arrays, but no compact records
    return kept


def _access(section: Section, path: str, mended: list[str]) -> str:
    access = section.values.get("AccessType", "").lower()
    if not access:
        mended.append(f"[{section.name}] AccessType: missing, read as rw")
        return "rw"
    if access not in _ACCESS:
        raise invalid("cannot be read", section, "AccessType", path, expected=", ".join(_ACCESS), got=repr(access))
    return access


def _is_variable(section: Section, path: str) -> bool:
    """Return whether the section describes a value, rather than an array or record of values."""
    if "ObjectType" not in section.values:
        return True
    kind = _kind(section, path)
    compact = int(_number(section, "CompactSubObj", "0", path, []) if "CompactSubObj" in section.values else "0", 0)
    return kind in (0x2, 0x7) or "sub" in section.name or bool(compact)


def _spell_out(values: Section, parent: Section, kept: dict[str, Section], path: str, mended: list[str]) -> None:
    """Write the entries of a compact array as separate sub-objects with the values of [xxxxValue] (CiA 306, 4.7.3).

    [xxxxValue] holds the values that a DCF sets in a compact array; the `canopen` reader does not know that section.
    """
    array = kept[parent.name]
    if "CompactSubObj" not in array.values:
        mended.append(f"[{values.name}]: left out, [{parent.name}] is not a compact array")
        return
    count = min(int(array.values["CompactSubObj"], 0), 254)
    for key in values.values:
        if key != "NrOfEntries" and not (key.isdecimal() and 1 <= int(key) <= count):
            mended.append(f"[{values.name}] {key}: left out, there are {count} entries")
    names = kept.get(f"{parent.name}Name", Section("", 0)).values
    every = {key: value for key, value in array.values.items() if key not in ("CompactSubObj", "ObjectType")}
    for sub in range(1, count + 1):
        own = Section(f"{parent.name}sub{sub:X}", values.line, dict(every), dict(array.lines))
        own.values["ParameterName"] = names.get(str(sub)) or f"{array.values['ParameterName']}{sub}"
        if value := values.values.get(str(sub)):
            own.values["ParameterValue"], own.lines["ParameterValue"] = value, values.lines[str(sub)]
        kept[own.name] = own


def _repair_names(names: Section, parent: Section, kept: dict[str, Section], path: str, mended: list[str]) -> None:
    """Complete [xxxxName], which lists the names of a compact array's entries only where they differ from the default."""
    array = kept[parent.name]
    if "CompactSubObj" not in array.values:
        mended.append(f"[{names.name}]: left out, [{parent.name}] is not a compact array")
        return
    count = int(array.values["CompactSubObj"], 0)
    filled = Section(names.name, names.line, {"NrOfEntries": str(count)})
    for sub in range(1, min(count, 254) + 1):
        filled.values[str(sub)] = names.values.get(str(sub)) or f"{array.values['ParameterName']}{sub}"
    kept[names.name] = filled
