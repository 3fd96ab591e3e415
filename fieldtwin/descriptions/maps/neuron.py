"""Tags of EMQX Neuron's Modbus drivers: a CSV file with the columns of Neuron's spreadsheet, or the JSON of its HTTP API.

An address is ``SLAVE!ADDRESS[.BIT][#ENDIAN][.LENGTH[H|L|D|E]]``. Its first digit is the table, and the others are the register,
counted from 1: 000001 coil, 100001 discrete input, 300001 input register, 400001 holding register (documentation of the driver
Modbus TCP, version 2.9). Neuron's driver can be set to count from 0; the setting ``start=0`` of the import reads such addresses.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Mapping
from typing import Any

from fieldtwin.descriptions.conversion import Exported, Imported, Loss, Settings, Source, whole_setting
from fieldtwin.descriptions.maps.documents import Document, Loc, parse_json, text_of
from fieldtwin.descriptions.maps.drafting import Draft, choose, slug
from fieldtwin.descriptions.maps.rendering import Abilities, descriptions, exported, shorten
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile import BIT_TABLES, REGISTERS_OF, DeviceProfile, Table, Tag

ABILITIES = Abilities(
    "Neuron",
    keeps={"access", "poll", "offset", "description"},
    types={"int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64", "string", "bytes"},
    write_only=True,
    single_bits=True,
)

COLUMNS = ("group", "interval", "name", "address", "attribute", "type", "description", "decimal", "precision", "bias")
INTERVAL_MS = 1000
"""The interval of a group in an export, in milliseconds. A profile has no interval."""

_TABLES: dict[str, Table] = {"0": "coil", "1": "discrete", "3": "input", "4": "holding"}
_DIGITS = {table: digit for digit, table in _TABLES.items()}
_TYPES = {
    "INT16": "int16", "UINT16": "uint16", "WORD": "uint16", "INT32": "int32", "UINT32": "uint32", "DWORD": "uint32",
    "INT64": "int64", "UINT64": "uint64", "LWORD": "uint64", "FLOAT": "float32", "DOUBLE": "float64", "BIT": "bool",
    "BOOL": "bool", "STRING": "string", "BYTES": "bytes",
}  # fmt: skip
_NAMES = {kind: name for name, kind in reversed(_TYPES.items())} | {"bool": "BIT"}
_NUMBERED = (
    "", "INT8", "UINT8", "INT16", "UINT16", "INT32", "UINT32", "INT64", "UINT64", "FLOAT", "DOUBLE", "BIT", "BOOL",
    "STRING", "BYTES", "ERROR", "WORD", "DWORD", "LWORD",
)  # fmt: skip
"""The types by their numbers in the HTTP API."""
_ENDIANS = {"B": "BADC", "L": "ABCD", "LL": "ABCD", "LB": "BADC", "BL": "CDAB", "BB": "DCBA"}
_LONG_ENDIANS = {"BADC": "#LB", "CDAB": "#BL", "DCBA": "#BB"}
_ADDRESS = re.compile(
    r"(?P<unit>\d{1,3})!(?P<table>[0134])(?P<number>\d{4,5})(?:\.(?P<bit>\d{1,3})(?P<layout>[HLDE])?)?"
    r"(?:#(?P<endian>[BL]{1,2}))?(?:\.(?P<length>\d{1,3})(?P<layout2>[HLDE])?)?"
)


def import_description(source: Source, settings: Settings) -> Imported:
    """Return the profile of one device. The setting ``select`` selects a unit ID, and ``start`` is Neuron's start address."""
    start = whole_setting(settings, "start", 0, 1)
    document = _csv_document(source) if text_of(source).lstrip()[:1] not in ("{", "[") else parse_json(source)
    rows = [(loc, row, _parsed(document, loc, row)) for loc, row in _rows(document)]
    units = list(dict.fromkeys(int(found["unit"]) for _, _, found in rows))
    index = choose([("unit", unit) for unit in units], settings.get("select", ""), document.path)
    draft = Draft(document, source.path.stem, "tags of EMQX Neuron", settings)
    draft.factory(unit=units[index])
    for loc, row, found in rows:
        if int(found["unit"]) == units[index]:
            _import_row(document, loc, row, found, 1 if start is None else start, draft)
    return draft.imported()


def _csv_document(source: Source) -> Document:
    """Parse a CSV file with a header. The data is a list of rows, each with its columns."""
    path, text = str(source.path), text_of(source)
    try:
        sample = text[:4096]
        separator = max(",;\t", key=sample.partition("\n")[0].count)
        reader = csv.DictReader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
        lines: list[int] = []
        rows = []
        for row in reader:
            lines.append(reader.line_num)
            rows.append({str(key).strip().lower(): value for key, value in row.items() if isinstance(value, str)})
        columns = [name.strip().lower() for name in reader.fieldnames or ()]
    except csv.Error as e:
        raise FileInvalid(f"not CSV: {e}", path=path, line=1) from e
    if missing := [name for name in ("name", "address", "type") if name not in columns]:
        raise FileInvalid(
            f"the header has no column {missing[0]!r}",
            path=path,
            line=1,
            expected=", ".join(COLUMNS),
            got=", ".join(columns)[:200],
        )
    return Document(path, rows, lambda loc: (lines[loc[0]] if loc and isinstance(loc[0], int) else 1, 1))


def _rows(document: Document) -> Iterator[tuple[Loc, dict[str, Any]]]:
    """Yield the tags of a CSV file, of a list of tags, of a group with tags, and of several groups."""
    data = document.data
    if isinstance(data, list):
        for loc, row in document.entries(data, (), "the list of tags"):
            if any(str(value).strip() for value in row.values()):
                yield loc, row
        return
    outer = document.mapping(data, (), "the file")
    groups = document.entries(outer["groups"], ("groups",), "`groups`") if "groups" in outer else [((), outer)]
    for loc, group in groups:
        name = group.get("group") or group.get("name") or "values"
        for place, row in document.entries(group.get("tags"), (*loc, "tags"), "`tags`"):
            yield place, row | {"group": name}


def _parsed(document: Document, loc: Loc, row: Mapping[str, Any]) -> dict[str, str]:
    text = str(row.get("address", "")).strip().replace(" ", "")
    match = _ADDRESS.fullmatch(text)
    if match is None:
        raise document.error(
            (*loc, "address"),
            "the address",
            expected="1!400001, 1!300004.3, 1!400001#BL or 1!400001.10H",
            got=repr(text),
        )
    return {key: value or "" for key, value in match.groupdict().items()}


def _import_row(
    document: Document, loc: Loc, row: Mapping[str, Any], found: Mapping[str, str], start: int, draft: Draft
) -> None:
    name = document.text(row.get("name"), (*loc, "name"), "`name`")
    place, table = f"tag {name}", _TABLES[found["table"]]
    address = document.integer(int(found["number"]) - start, (*loc, "address"), "the address, counted from 0", 0, 65535)
    kind = _type(document, loc, row)
    access = _access(document, loc, row)
    fields: dict[str, Any] = {"poll": slug(str(row.get("group") or "")) or None, "access": access}
    if fields["poll"] == "values":
        fields["poll"] = None
    if text := str(row.get("description") or "").strip():
        fields["description"] = text
    if access != "ro" and table in ("discrete", "input"):
        draft.lose(place, "write access", f"the table {table} cannot be written")
        fields["access"] = None
    if table not in BIT_TABLES:
        if kind in ("INT8", "UINT8", "ERROR"):
            draft.lose(place, "the tag", f"a profile has no type {kind} of registers")
            return
        more = _register_fields(document, loc, row, found, _TYPES[kind], place, draft)
        if more is None:
            return
        fields |= more
        if fields.get("bits") and fields["access"] in ("rw", "wo"):
            draft.lose(place, "write access", "a bit of a register is only read")
            fields["access"] = None
    for key in ("precision", "interval"):
        if str(row.get(key) or "").strip() not in ("", "0"):
            draft.lose(f"column {key}", f"`{key}`", "the profile has no equivalent")
    draft.add(loc, name, table, address, **fields)


def _type(document: Document, loc: Loc, row: Mapping[str, Any]) -> str:
    value = row.get("type", "")
    if isinstance(value, int) or re.fullmatch(r"[0-9]{1,2}", str(value)):
        number = document.integer(value, (*loc, "type"), "`type`", 1, len(_NUMBERED) - 1)
        return _NUMBERED[number]
    name = str(value).strip().upper()
    if name not in _NUMBERED[1:]:
        raise document.error((*loc, "type"), "`type`", expected=", ".join(_TYPES), got=repr(value))
    return name


def _access(document: Document, loc: Loc, row: Mapping[str, Any]) -> str:
    """Return the access of an attribute such as ``Read Write``, or of its bits: 1 read, 2 write, 4 subscribe."""
    value = row.get("attribute", "Read")
    if isinstance(value, int) or re.fullmatch(r"[0-9]{1,2}", str(value)):
        bits = document.integer(value, (*loc, "attribute"), "`attribute`", 1, 15)
        read, write = bool(bits & 5), bool(bits & 2)
    else:
        words = re.findall(r"[a-z]+", str(value).lower())
        read, write = bool({"read", "subscribe"} & set(words)), "write" in words
    if not read and not write:
        raise document.error((*loc, "attribute"), "`attribute`", expected="Read, Write or Subscribe", got=repr(value))
    return "rw" if read and write else "wo" if write else "ro"


def _register_fields(
    document: Document, loc: Loc, row: Mapping[str, Any], found: Mapping[str, str], kind: str, place: str, draft: Draft
) -> dict[str, Any] | None:
    """Return type, order, length, bits and scale of a tag of registers; None if a profile cannot hold the value."""
    if kind == "bool":
        bit = document.integer(found["bit"] or "0", (*loc, "address"), "the bit", 0, 15)
        return {"bits": (bit, bit)}
    order = _ENDIANS.get(found["endian"] or "L")
    if order is None:
        raise document.error((*loc, "address"), "the byte order", expected=", ".join(f"#{e}" for e in _ENDIANS))
    if kind in ("string", "bytes"):
        length = document.integer(found["length"] or found["bit"], (*loc, "address"), "the length in bytes", 1, 250)
        layout = found["layout2"] or found["layout"] or "H"
        if layout in ("D", "E"):
            draft.lose(place, "the tag", "it has one character in each register")
            return None
        return {"type": kind, "registers": -(-length // 2), "order": "BADC" if layout == "L" else None}
    if REGISTERS_OF[kind] == 4 and not found["endian"]:
        draft.lose(
            place, "certainty of the byte order", "Neuron's driver has a setting for 64 bits; big endian was taken"
        )
    fields: dict[str, Any] = {"type": kind, "order": None if order == "ABCD" else order}
    for key, column, usual in (("scale", "decimal", 1.0), ("offset", "bias", 0.0)):
        text = str(row.get(column) if row.get(column) is not None else "").strip()
        number = document.number(text, (*loc, column), f"`{column}`") if text else usual
        if column == "decimal" and number == 0:  # Neuron writes 0 for a value without a factor
            number = usual
        fields[key] = number if number != usual else None
    return fields


def export_description(profile: DeviceProfile, settings: Settings) -> Exported:
    """Return a CSV file with the columns of Neuron's spreadsheet. It has no settings."""
    losses: list[Loss] = []
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\r\n")
    writer.writerow(COLUMNS)
    described = descriptions(profile)
    for tag in exported(profile, ABILITIES, losses):
        address = _address(tag, profile.form.factory.unit)
        if not address:
            losses.append(Loss(f"tag {tag.name}", "the tag", f"Neuron has no byte order {tag.order} for {tag.type}"))
            continue
        attribute = {"ro": "Read", "rw": "Read Write", "wo": "Write"}[tag.access]
        if tag.danger and tag.writable:
            losses.append(Loss(f"tag {tag.name}", "write access", "its write is dangerous"))
            if not tag.readable:
                continue
            attribute = "Read"
        text = described.get(tag.name, {}).get("description", "")
        kind = "BIT" if tag.bits is not None else _NAMES[tag.type]
        scale, bias = ("" if tag.scale == 1 else shorten(tag.scale)), ("" if tag.offset == 0 else shorten(tag.offset))
        row = (tag.poll, INTERVAL_MS, tag.name, address, attribute, kind, _cell(text), scale, "", bias)
        writer.writerow(row)
    return Exported(out.getvalue().encode(), tuple(losses))


def _cell(text: str) -> str:
    """Return a text that a spreadsheet does not take for a formula."""
    return f"'{text}" if text[:1] in ("=", "+", "-", "@") else text


def _address(tag: Tag, unit: int) -> str:
    """Return the address of a tag, or an empty text if Neuron's notation has no such byte order."""
    at = tag.registers
    base = f"{unit}!{_DIGITS[at.table]}{at.address + 1:05d}"
    if tag.type == "bool":
        return base
    if tag.bits is not None:
        return f"{base}.{tag.bits[0]}"
    swapped = tag.order in ("BADC", "DCBA")
    if tag.type == "string":
        return f"{base}.{2 * at.count}{'L' if swapped else 'H'}"
    if tag.type == "bytes":
        return f"{base}.{2 * at.count}"
    if at.count == 1:
        return f"{base}#B" if swapped else base
    if tag.order == "ABCD":
        return base
    return f"{base}{_LONG_ENDIANS[tag.order]}" if at.count == 2 else ""
