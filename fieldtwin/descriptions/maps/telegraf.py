"""Telegraf's input plugin ``inputs.modbus`` (TOML): the configuration styles ``register``, ``request`` and ``metric``.

Telegraf's addresses are those that are sent, from 0 (documentation of the plugin, version 1.32). It only reads. Strings need
Telegraf 1.29, single bits 1.32.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

from fieldtwin.descriptions.conversion import Exported, Imported, Loss, Settings, Source
from fieldtwin.descriptions.maps.documents import Document, Loc, parse_toml
from fieldtwin.descriptions.maps.drafting import Draft, choose
from fieldtwin.descriptions.maps.rendering import Abilities, exported, shorten, stated_endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.profile import BIT_TABLES, REGISTERS_OF, DeviceProfile, Table, Tag

ABILITIES = Abilities(
    "Telegraf",
    keeps={"poll"},
    types={"int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64", "string"},
    single_bits=True,
)

_TABLES: dict[str, Table] = {
    "discrete_inputs": "discrete", "coils": "coil", "holding_registers": "holding", "input_registers": "input",
}  # fmt: skip
_REGISTERS: dict[str, Table] = {"coil": "coil", "discrete": "discrete", "holding": "holding", "input": "input"}
_TYPES = {
    "INT16": "int16", "UINT16": "uint16", "INT32": "int32", "UINT32": "uint32", "INT64": "int64", "UINT64": "uint64",
    "FLOAT32": "float32", "FLOAT64": "float64", "FLOAT32-IEEE": "float32", "FLOAT64-IEEE": "float64", "STRING": "string",
    "BIT": "uint16", "UINT8L": "uint16", "UINT8H": "uint16",
}  # fmt: skip
_BYTES = {"UINT8L": (0, 7), "UINT8H": (8, 15)}
_UNSIGNED = ("uint16", "uint32", "uint64")
_FIXED = {"FIXED": ("int16", "int32", "int64"), "UFIXED": _UNSIGNED, "FLOAT32": _UNSIGNED}
"""Integer types of the register style by their length. Its FLOAT32 is an unsigned fixed-point number, not a float."""
_ORDERS = {
    "": "ABCD", "AB": "ABCD", "ABCD": "ABCD", "ABCDEFGH": "ABCD", "BA": "DCBA", "DCBA": "DCBA", "HGFEDCBA": "DCBA",
    "BADC": "BADC", "BADCFEHG": "BADC", "CDAB": "CDAB", "GHEFCDAB": "CDAB",
}  # fmt: skip
_LONG_ORDERS = {
    1: {"ABCD": "AB", "CDAB": "AB", "BADC": "BA", "DCBA": "BA"},
    2: {"ABCD": "ABCD", "CDAB": "CDAB", "BADC": "BADC", "DCBA": "DCBA"},
    4: {"ABCD": "ABCDEFGH", "CDAB": "GHEFCDAB", "BADC": "BADCFEHG", "DCBA": "HGFEDCBA"},
}
_STYLES = ("register", "request", "metric")


def import_description(source: Source, settings: Settings) -> Imported:
    """Return the profile of one device of a Telegraf configuration. The setting ``select`` selects it if there are several."""
    document = parse_toml(source)
    inputs = document.mapping(document.data.get("inputs") or {}, (), "`inputs`")
    found = inputs.get("modbus")
    plugins = document.entries([found] if isinstance(found, dict) else found, ("inputs", "modbus"), "`inputs.modbus`")
    devices = [(each, unit) for each in plugins for unit in _units(document, *each)]
    labels = [(str(each[1].get("name") or f"modbus{i}"), unit) for i, (each, unit) in enumerate(devices, 1)]
    index = choose(labels, settings.get("select", ""), document.path)
    (loc, plugin), unit = devices[index]
    draft = Draft(document, labels[index][0], "Telegraf's inputs.modbus", settings)
    draft.factory(unit=unit)
    _import_connection(document, loc, plugin, draft)
    for place, field, table, order, style in _fields(document, loc, plugin, unit, draft):
        _import_field(document, place, field, table, order, style, draft)
    return draft.imported()


def _style(document: Document, loc: Loc, plugin: Mapping[str, Any]) -> str:
    style = plugin.get("configuration_type", "register")
    return document.choice(style, (*loc, "configuration_type"), "`configuration_type`", _STYLES)


def _units(document: Document, loc: Loc, plugin: Mapping[str, Any]) -> list[int]:
    """Return the unit IDs of a plugin. Only the register style states one unit ID for all registers."""
    style = _style(document, loc, plugin)
    if style == "register":
        return [document.integer(plugin.get("slave_id", 0), (*loc, "slave_id"), "`slave_id`", 0, 255)]
    units = [
        document.integer(each.get("slave_id", 0), (*place, "slave_id"), "`slave_id`", 0, 255)
        for place, each in document.entries(plugin.get(style), (*loc, style), f"`{style}`")
    ]
    return list(dict.fromkeys(units))


def _import_connection(document: Document, loc: Loc, plugin: Mapping[str, Any], draft: Draft) -> None:
    controller = str(plugin.get("controller", ""))
    if controller.startswith("file:") or "baud_rate" in plugin:
        draft.serial(loc, plugin, ("baud_rate", "data_bits", "parity", "stop_bits"))
    if controller:
        draft.note("key controller", f"address {controller}", "an endpoint belongs in the system file")
    for key in ("timeout", "busy_retries", "workarounds", "optimization", "tags"):
        if key in plugin:
            draft.lose(f"key {key}", f"`{key}`", "the profile has no equivalent")


def _fields(
    document: Document, loc: Loc, plugin: Mapping[str, Any], unit: int, draft: Draft
) -> Iterator[tuple[Loc, dict[str, Any], Table, object, str]]:
    """Yield each field with its place, its table, its byte order, and the style. The tags of a block are listed as a loss."""
    style = _style(document, loc, plugin)
    if style == "register":
        for key, table in _TABLES.items():
            for place, field in document.entries(plugin.get(key), (*loc, key), f"`{key}`"):
                yield place, field, table, field.get("byte_order", ""), style
        return
    for n, (place, block) in enumerate(document.entries(plugin.get(style), (*loc, style), f"`{style}`"), 1):
        if document.integer(block.get("slave_id", 0), (*place, "slave_id"), "`slave_id`", 0, 255) != unit:
            continue
        for name in document.mapping(block.get("tags") or {}, (*place, "tags"), "`tags`"):
            draft.lose(f"{style} {n}", f"tag {name} of the metric", "the profile has no equivalent")
        for at, field in document.entries(block.get("fields"), (*place, "fields"), "`fields`"):
            name = (block if style == "request" else field).get("register", "holding")
            table = _REGISTERS[document.choice(name, (*at, "register"), "`register`", _REGISTERS)]
            measurement = field.get("measurement") or block.get("measurement")
            yield at, field | {"measurement": measurement}, table, block.get("byte_order", ""), style


def _import_field(
    document: Document, loc: Loc, field: Mapping[str, Any], table: Table, order: object, style: str, draft: Draft
) -> None:
    if field.get("omit"):
        return
    name = document.text(field.get("name"), (*loc, "name"), "`name`")
    address, length = _span(document, loc, field, style)
    fields: dict[str, Any] = {"poll": _poll(field.get("measurement"))}
    if table in BIT_TABLES and length > 1:
        draft.lose(f"field {name}", f"the {length - 1} bits after {address}", "a tag is one bit")
    if table in ("holding", "input"):
        kind = str(field.get("data_type" if style == "register" else "type", "")).upper()
        kind = _normal_type(document, loc, kind, length, style)
        if kind not in _TYPES:
            if kind in ("INT8L", "INT8H", "FLOAT16"):
                draft.lose(f"field {name}", "the tag", f"a profile has no type {kind}")
                return
            raise document.error(loc, f"the type of {name!r}", expected=", ".join(_TYPES), got=kind or "nothing")
        found = _ORDERS[document.choice(order, loc, f"the byte order of {name!r}", _ORDERS)]
        fields |= {"type": _TYPES[kind], "order": None if found == "ABCD" else found}
        if kind == "STRING":
            fields["registers"] = length or document.integer(field.get("length"), (*loc, "length"), "`length`", 1, 125)
        elif length not in (0, REGISTERS_OF[_TYPES[kind]]):
            raise document.error(loc, f"the number of addresses of {name!r}", expected=f"{REGISTERS_OF[_TYPES[kind]]}")
        if kind in _BYTES:
            fields["bits"] = _BYTES[kind]
        if kind == "BIT":
            bit = document.integer(field.get("bit", 0), (*loc, "bit"), "`bit`", 0, 15)
            fields["bits"] = (bit, bit)
        scale = document.number(field.get("scale", 1) or 1, (*loc, "scale"), "`scale`")
        fields["scale"] = scale if scale != 1 and kind not in ("STRING", "BIT") else None
    if "output" in field:
        draft.lose(f"field {name}", "`output`", "the gateway has one type for each tag")
    draft.add(loc, name, table, address, **fields)


def _normal_type(document: Document, loc: Loc, kind: str, length: int, style: str) -> str:
    """Return the type of a field; the fixed-point types of the register style become integers."""
    if style == "register" and kind in _FIXED:
        if length not in (1, 2, 4):
            raise document.error(loc, f"the number of addresses of a {kind}", expected="1, 2 or 4", got=str(length))
        return _FIXED[kind][(1, 2, 4).index(length)].upper()
    return kind


def _span(document: Document, loc: Loc, field: Mapping[str, Any], style: str) -> tuple[int, int]:
    """Return the first address, and the number of addresses, or 0 if the style does not state it."""
    at = (*loc, "address")
    if style != "register":
        return document.integer(field.get("address"), at, "`address`", 0, 65535), 0
    stated = field.get("address")
    if not isinstance(stated, list) or not 1 <= len(stated) <= 125:
        raise document.error(
            at, "`address`", expected="a list of 1 to 125 addresses, such as [0, 1]", got=repr(stated)[:40]
        )
    addresses = [document.integer(each, at, "`address`", 0, 65535) for each in stated]
    if addresses != list(range(addresses[0], addresses[0] + len(addresses))):
        raise document.error(at, "`address`", expected="consecutive addresses", got=repr(stated)[:40])
    return addresses[0], len(addresses)


def _poll(measurement: object) -> str | None:
    """Return the poll group of a measurement; Telegraf's usual measurement is the usual group."""
    name = re.sub(r"[^a-z0-9]+", "_", str(measurement or "").lower()).strip("_")
    return None if name in ("", "modbus", "values") else name


def export_description(profile: DeviceProfile, settings: Settings) -> Exported:
    """Return an ``[[inputs.modbus]]`` section. Settings: ``endpoint``, and ``style``: request (usual) or register."""
    style = settings.get("style", "request")
    if style not in ("request", "register"):
        raise UsageError(f"cannot use --set style={style}", expected="request or register")
    losses: list[Loss] = []
    tags = list(exported(profile, ABILITIES, losses))
    lines = [f"# {profile.name}: written by fieldtwin from a device profile.", "[[inputs.modbus]]"]
    lines += [f"  {key} = {_toml(value)}" for key, value in _connection(profile, settings.get("endpoint", ""), losses)]
    lines.append(f"  configuration_type = {_toml(style)}")
    lines += _register_lines(profile, tags) if style == "register" else _request_lines(profile, tags)
    return Exported(("\n".join(lines) + "\n").encode(), tuple(losses))


def _connection(profile: DeviceProfile, endpoint: str, losses: list[Loss]) -> Iterator[tuple[str, object]]:
    found, serial = stated_endpoint(profile, endpoint, losses)
    yield "name", profile.name
    if found.is_serial:
        yield "controller", f"file://{found.path}"
        yield "baud_rate", serial.baudrate
        yield "data_bits", serial.data_bits
        yield "parity", serial.parity
        yield "stop_bits", serial.stop_bits
        yield "transmission_mode", "ASCII" if found.scheme == "ascii" else "RTU"
    else:
        if found.scheme == "udp":
            raise UsageError(f"{endpoint} cannot be exported", expected="tcp:, rtu+tcp:, rtu: or ascii: for Telegraf")
        yield "controller", f"tcp://{found.host}:{found.port}"
        if found.scheme == "rtu+tcp":
            yield "transmission_mode", "RTUoverTCP"
    yield "slave_id", profile.form.factory.unit
    yield "timeout", f"{profile.form.timing.timeout_ms or 1000}ms"


def _type(tag: Tag, style: str) -> str:
    if tag.bits is not None:
        return "BIT"
    return tag.type.upper() + ("-IEEE" if style == "register" and tag.type.startswith("float") else "")


def _register_lines(profile: DeviceProfile, tags: list[Tag]) -> Iterator[str]:
    for key, table in _TABLES.items():
        inside = [tag for tag in tags if tag.registers.table == table]
        if not inside:
            continue
        yield f"  {key} = ["
        for tag in inside:
            at = tag.registers
            fields: dict[str, object] = {"name": tag.name}
            if tag.poll != "values":
                fields["measurement"] = tag.poll
            if tag.type != "bool":
                fields["byte_order"] = _LONG_ORDERS[at.count if tag.type != "string" else 1][tag.order]
                fields["data_type"] = _type(tag, "register")
                if tag.bits is not None:
                    fields["bit"] = tag.bits[0]
                fields["scale"] = float(tag.scale)
            yield f"    {_inline(fields | {'address': list(range(at.address, at.end))})},"
        yield "  ]"


def _request_lines(profile: DeviceProfile, tags: list[Tag]) -> Iterator[str]:
    groups: dict[tuple[str, str, str], list[Tag]] = {}
    for tag in tags:
        order = "ABCD" if tag.type == "bool" else tag.order
        groups.setdefault((tag.registers.table, order, tag.poll), []).append(tag)
    for (table, order, poll), inside in groups.items():
        yield ""
        yield "  [[inputs.modbus.request]]"
        yield f"    slave_id = {profile.form.factory.unit}"
        yield f'    byte_order = "{order}"'
        yield f'    register = "{table}"'
        if poll != "values":
            yield f"    measurement = {_toml(poll)}"
        yield "    fields = ["
        for tag in inside:
            fields: dict[str, object] = {"address": tag.registers.address, "name": tag.name}
            if tag.type != "bool":
                fields["type"] = _type(tag, "request")
            if tag.type == "string":
                fields["length"] = tag.registers.count
            if tag.bits is not None:
                fields["bit"] = tag.bits[0]
            elif tag.scale != 1:
                fields["scale"] = float(tag.scale)
            yield f"      {_inline(fields)},"
        yield "    ]"


def _inline(fields: Mapping[str, object]) -> str:
    return "{ " + ", ".join(f"{key} = {_toml(value)}" for key, value in fields.items()) + " }"


def _toml(value: object) -> str:
    """Return a value of TOML. Its basic strings have the escapes of JSON."""
    if isinstance(value, float):
        return repr(float(shorten(value)))
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
