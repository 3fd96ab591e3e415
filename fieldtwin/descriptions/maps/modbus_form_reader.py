"""Read properties and forms of the W3C's Modbus binding (`fieldtwin.descriptions.maps.modbus_forms`) as tags.

Published files often leave two things unstated. Without ``modv:zeroBasedAddressing: true`` the binding counts from 1, while its
examples have numbers with the digit of the table (40001), and Eclipse's node-wot sends each number unchanged: the setting
``numbering`` decides. With ``modv:mostSignificantByte: false`` alone, a value of several registers is little-endian (DCBA), as in
the binding's example.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qsl

from fieldtwin.descriptions.conversion import Imported, Settings
from fieldtwin.descriptions.maps.documents import Document, Loc
from fieldtwin.descriptions.maps.drafting import TABLE_OF_FUNCTION, Draft, choose
from fieldtwin.descriptions.maps.modbus_forms import BYTE_SEQUENCES, ENTITIES, TYPES
from fieldtwin.descriptions.profile_text import printable
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.profile import BIT_TABLES, REGISTERS_OF, Table

NUMBERINGS = ("sent", "one", "printed")
MAX_DESCRIPTION = 300
"""The largest number of characters of a description that a tag keeps."""

_TABLES: dict[str, Table] = {name.lower(): table for table, name in ENTITIES.items()}
_DIGITS: dict[Table, int] = {"coil": 0, "discrete": 1, "input": 3, "holding": 4}
_KINDS = {name.removeprefix("xsd:").lower(): kind for kind, name in TYPES.items()} | {"hexbinary": "bytes"}
_ORDERS = {sequence: order for order, sequence in BYTE_SEQUENCES.items()}
_ORDER_OF_FLAGS = {(True, True): "ABCD", (True, False): "CDAB", (False, True): "BADC", (False, False): "DCBA"}
_URI = re.compile(
    r"modbus(?:\+[a-z]+)?://[^/?#\s]*(?:/(?P<unit>[^/?#\s]*))?(?:/(?P<address>[^/?#\s]*))?(?:\?(?P<query>[^#\s]*))?"
)


@dataclass(frozen=True)
class ModbusForm:
    """A form with a Modbus URI, its property, and the table, unit and number that it states. `loc` is the place of the form."""

    loc: Loc
    name: str
    schema: Mapping[str, Any]
    terms: Mapping[str, Any]
    table: Table
    unit: int
    number: int
    quantity: int | None
    writes_only: bool
    reads_only: bool


def import_properties(
    document: Document, loc: Loc, thing: Mapping[str, Any], program: str, settings: Settings, *, states_access: bool
) -> Imported:
    """Return the profile of one unit of a thing: its ``properties``, ``base`` and ``title``.

    The settings ``select`` and ``numbering`` apply. Without `states_access` the format names no operations, and a value is
    written only if its form has a function that writes.
    """
    title = str(thing.get("title") or "thing")
    skipped: list[tuple[str, str]] = []
    forms = list(_forms(document, loc, thing, skipped, states_access))
    units = list(dict.fromkeys(form.unit for form in forms))
    index = choose([(title, unit) for unit in units], settings.get("select", ""), document.path)
    draft = Draft(document, title, program, settings)
    draft.factory(unit=units[index])
    draft.note("the forms", "address of the device", "an endpoint belongs in the system file")
    for name, why in skipped:
        draft.lose(f"property {name}", "the form", why)
    for kind in ("actions", "events"):
        for name in document.mapping(thing.get(kind) or {}, (*loc, kind), f"`{kind}`"):
            draft.lose(f"{kind[:-1]} {name}", "the interaction", f"a profile has no {kind}")
    forms = [form for form in forms if form.unit == units[index]]
    numbering = _numbering(document, forms, settings.get("numbering", ""))
    for form in forms:
        _add(document, form, numbering, draft)
    return draft.imported()


def _forms(
    document: Document, loc: Loc, thing: Mapping[str, Any], skipped: list[tuple[str, str]], states_access: bool
) -> Iterator[ModbusForm]:
    """Yield the Modbus forms of all properties; others go to `skipped`."""
    base = str(thing.get("base") or "")
    found = document.mapping(thing.get("properties") or {}, (*loc, "properties"), "`properties`")
    for name, value in found.items():
        place = (*loc, "properties", name)
        schema = document.mapping(value, place, f"property {name!r}")
        for at, form in document.entries(schema.get("forms"), (*place, "forms"), f"`forms` of {name!r}"):
            terms = {re.sub(r"^(modv|modbus)[:_]", "", key): each for key, each in form.items()}
            href = _resolved(base, document.text(form.get("href", base), (*at, "href"), f"`href` of {name!r}"))
            match = _URI.fullmatch(href)
            if match is None:
                if href.startswith("modbus"):
                    expected = "modbus+tcp://HOST:PORT/UNIT/ADDRESS?quantity=N"
                    raise document.error((*at, "href"), f"`href` of {name!r}", expected=expected, got=href[:80])
                skipped.append((name, f"{href.partition(':')[0][:20]} is not Modbus"))
                continue
            read = _form(document, at, name, schema, terms, match, states_access)
            if read is None:
                skipped.append((name, f"its function {terms.get('function')!r} reads no register"))
            else:
                yield read


def _resolved(base: str, href: str) -> str:
    """Return an absolute URI. A relative one is appended to the base: ``.../1`` and ``.../1/`` both name the unit.

    RFC 3986 would drop the 1 without a slash, and published descriptions do not mean that.
    """
    if re.match(r"[a-zA-Z][a-zA-Z0-9+.-]*:", href) or not base:
        return href
    base = base.partition("?")[0]
    if href.startswith("?"):
        return base + href
    if href.startswith("/"):
        authority = re.match(r"[a-zA-Z][a-zA-Z0-9+.-]*://[^/?#]*", base)
        return (authority[0] if authority else base) + href
    return f"{base.removesuffix('/')}/{href}"


def _form(
    document: Document,
    loc: Loc,
    name: str,
    schema: Mapping[str, Any],
    terms: Mapping[str, Any],
    uri: re.Match[str],
    states_access: bool,
) -> ModbusForm | None:
    """Return a Modbus form, or None if its function reads and writes no register."""
    entity, function = terms.get("entity"), terms.get("function")
    table = _table_of_function(function) if function is not None else None
    if entity is not None:
        text = document.text(entity, (*loc, "modv:entity"), f"`modv:entity` of {name!r}").lower()
        table = _TABLES[document.choice(text, (*loc, "modv:entity"), f"`modv:entity` of {name!r}", _TABLES)]
    elif function is None:
        raise document.error(loc, f"the form of {name!r} has no register", expected="`modv:entity` or `modv:function`")
    if table is None:
        return None
    path = {key: value for key, value in (("unitID", uri["unit"]), ("address", uri["address"])) if value}
    older = {"address": terms.get("offset"), "quantity": terms.get("length")}
    stated = older | dict(terms) | dict(parse_qsl(uri["query"] or "")) | path
    number = document.integer(stated.get("address"), (*loc, "href"), f"the address of {name!r}", 0, 465_536)
    unit = document.integer(stated.get("unitID", 1), (*loc, "href"), f"the unit ID of {name!r}", 0, 255)
    quantity = stated.get("quantity")
    if quantity is not None:
        quantity = document.integer(quantity, (*loc, "href"), f"the quantity of {name!r}", 1, 2000)
    reads, writes = _access(schema, terms, states_access)
    writes = writes and table in ("coil", "holding")
    return ModbusForm(loc, name, schema, terms, table, unit, number, quantity, writes and not reads, not writes)


def _table_of_function(function: object) -> Table | None:
    """Return the table that a function reads or writes: a code, or a name such as ``readInputRegisters``; None if it has none."""
    if isinstance(function, int) or (isinstance(function, str) and re.fullmatch("[0-9]{1,3}", function)):
        return TABLE_OF_FUNCTION.get(int(function))
    text = re.sub("^(read|write)(single|multiple)?|s$", "", str(function).lower())
    return _TABLES.get(text)


def _access(schema: Mapping[str, Any], terms: Mapping[str, Any], states_access: bool) -> tuple[bool, bool]:
    """Return whether a form reads and whether it writes the value."""
    function = str(terms.get("function", ""))
    if function:
        writes = function.startswith("write") or function in ("5", "6", "15", "16")
        return not writes, writes
    if not states_access:
        return True, False
    ops = terms.get("op", ["readproperty", "writeproperty"])
    ops = [ops] if isinstance(ops, str) else ops if isinstance(ops, list) else []
    reads = not schema.get("writeOnly") and any(op in ops for op in ("readproperty", "observeproperty"))
    writes = not schema.get("readOnly") and "writeproperty" in ops
    return reads or not writes, writes


def _numbering(document: Document, forms: Sequence[ModbusForm], stated: str) -> str:
    """Return how the forms without ``modv:zeroBasedAddressing: true`` write addresses: one of `NUMBERINGS`.

    Raises `UsageError` if neither the file nor the user states it. A guess would read other registers: the binding counts from 1,
    and Eclipse's elevator, a published test thing, answers to 40001 on the wire.
    """
    if stated:
        if stated not in NUMBERINGS:
            raise UsageError(f"cannot use --set numbering={stated}", expected=", ".join(NUMBERINGS))
        return stated
    unstated = [form for form in forms if form.terms.get("zeroBasedAddressing") is not True]
    if not unstated or any(form.number == 0 for form in unstated):
        return "sent"
    raise UsageError(
        f"{document.path}: the forms do not state `modv:zeroBasedAddressing: true`",
        expected="--set numbering=sent (the numbers are sent, as by node-wot), one (they count from 1, the binding's default) "
        "or printed (40001 is the first holding register)",
        got=f"the address {unstated[0].number} of {unstated[0].name!r}",
    )


def _printed(form: ModbusForm) -> int | None:
    """Return the address of a number with the digit of the table, such as 40001 or 400001; None if it has none."""
    if form.table == "coil":
        return form.number - 1 if form.number < 10_000 else None
    for digits in (10_000, 100_000):
        address = form.number - _DIGITS[form.table] * digits - 1
        if 0 <= address < min(digits, 65_536):
            return address
    return None


def _add(document: Document, form: ModbusForm, numbering: str, draft: Draft) -> None:
    """Add the tag of a form, or list why a profile cannot hold it."""
    place = f"property {form.name}"
    if form.terms.get("zeroBasedAddressing") is True:
        numbering = "sent"
    address = {"sent": form.number, "one": form.number - 1, "printed": _printed(form)}[numbering]
    if address is None or not 0 <= address < 65_536:
        expected = {"sent": "0 to 65535", "one": "1 to 65536", "printed": "the digit of the table first"}[numbering]
        raise document.error(
            (*form.loc, "href"), f"the address of {form.name!r}", expected=expected, got=str(form.number)
        )
    for key in ("pollingTime", "timeout"):
        if key in form.terms:
            draft.note(place, f"`modv:{key}`", "times belong in the system file")
    fields: dict[str, Any] = {"access": "wo" if form.writes_only else "ro" if form.reads_only else "rw"}
    text = form.schema.get("description") or form.schema.get("title")
    if isinstance(text, str) and printable(text):
        fields["description"] = printable(text)[:MAX_DESCRIPTION]
    if form.table in BIT_TABLES:
        if (form.quantity or 1) > 1:
            draft.lose(place, "all bits after the first", "a tag is one bit")
        draft.add(form.loc, form.name, form.table, address, **fields)
        return
    kind, why = _kind(form)
    if kind == "bool":
        kind = "uint16"
        draft.lose(place, "type boolean", "it is in a register, and is imported as a number")
    if why:
        draft.lose(place, "the tag", why)
        return
    fields |= {"type": kind, "order": _order(form, kind, draft)} | _limits(document, form, kind, draft)
    if kind in ("string", "bytes"):
        fields["registers"] = form.quantity
    draft.add(form.loc, form.name, form.table, address, **fields)


def _kind(form: ModbusForm) -> tuple[str, str]:
    """Return the type of the registers and an empty text, or the reason why a profile has no such type."""
    parameters = _parameters(form)
    stated = str(form.terms.get("type", "")).partition(":")[2].lower()
    length = parameters.get("length", "")
    count = form.quantity or (int(length) // 2 if re.fullmatch("[0-9]{1,4}", length) else 0)
    json_type = form.schema.get("type")
    if stated in _KINDS and stated != "boolean":
        kind = _KINDS[stated]
        if kind in ("string", "bytes"):
            return (kind, "") if 1 <= count <= 125 else (kind, f"a text of {count or 'unknown'} registers")
        if count not in (0, REGISTERS_OF[kind]):
            return kind, f"xsd:{stated} has {REGISTERS_OF[kind]} registers, but the form states {count}"
        return kind, ""
    count = count or 1
    if stated in ("byte", "unsignedbyte"):
        return "", f"a profile has no type xsd:{stated} in a register"
    if json_type == "boolean" or stated == "boolean":
        return ("bool", "") if count == 1 else ("", f"a boolean of {count} registers")
    if json_type == "string":
        return ("string", "") if count <= 125 else ("", f"a text of {count} registers")
    family = "float" if json_type == "number" and stated not in ("integer", "decimal") else "int"
    if family == "int" and json_type not in ("integer", "number"):
        return (
            "",
            f"its type is {json_type or 'not stated'}, and `modv:type` does not state how registers become a value",
        )
    minimum = form.schema.get("minimum")
    unsigned = parameters.get("signed") == "false" or (
        "signed" not in parameters and isinstance(minimum, int | float) and minimum >= 0
    )
    kind = f"{'u' if unsigned and family == 'int' else ''}{family}{16 * count}"
    return (kind, "") if kind in REGISTERS_OF else ("", f"a {json_type} of {count} registers, without `modv:type`")


def _parameters(form: ModbusForm) -> dict[str, str]:
    """Return the parameters of the content type, such as ``byteSeq`` and ``signed`` of Eclipse's node-wot."""
    parts = str(form.terms.get("contentType", "")).split(";")[1:]
    return {key.strip(): value.strip() for key, _, value in (part.partition("=") for part in parts)}


def _order(form: ModbusForm, kind: str, draft: Draft) -> str | None:
    """Return the byte order of a tag; None for ABCD, the usual one."""
    byte, word = form.terms.get("mostSignificantByte"), form.terms.get("mostSignificantWord")
    one = kind in ("string", "bytes") or REGISTERS_OF[kind] == 1
    if byte is None and word is None:
        order = _ORDERS.get(_parameters(form).get("byteSeq", ""), "ABCD")
    elif byte is False and word is None and not one:
        order = "DCBA"
        why = "the form has no `modv:mostSignificantWord`; little-endian was taken, as in the binding's example"
        draft.lose(f"property {form.name}", "certainty of the byte order", why)
    else:
        order = _ORDER_OF_FLAGS[byte is not False, word is not False]
    if one:
        order = "BADC" if order in ("BADC", "DCBA") else "ABCD"
    return None if order == "ABCD" else order


def _limits(document: Document, form: ModbusForm, kind: str, draft: Draft) -> dict[str, Any]:
    """Return the unit and the range of a number."""
    if kind in ("string", "bytes"):
        return {}
    schema, place = form.schema, f"property {form.name}"
    fields: dict[str, Any] = {}
    if isinstance(unit := schema.get("unit"), str) and printable(unit):
        fields["unit"] = printable(unit)[:40]
    low, high = schema.get("minimum"), schema.get("maximum")
    if low is not None and high is not None:
        loc = form.loc[:-2]
        limits = tuple(document.number(each, (*loc, "minimum"), f"the limits of {form.name!r}") for each in (low, high))
        if limits[0] > limits[1]:
            raise document.error((*loc, "minimum"), f"the limits of {form.name!r}", expected="minimum, then maximum")
        fields["range"] = limits
    elif low is not None or high is not None:
        draft.lose(place, "a single limit", "a range has both limits")
    for key in ("enum", "oneOf", "const", "multipleOf", "default"):
        if key in schema:
            draft.lose(place, f"`{key}`", "a profile has no equivalent")
    return fields
