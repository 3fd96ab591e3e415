"""The Modbus connector of ThingsBoard's IoT gateway (JSON): one device with attributes, time series, attribute updates and RPC.

Addresses are those that are sent, from 0. Two layouts are read: ``master: {slaves: [...]}`` (gateway 3) and the older ``server:
{devices: [...]}``. A value is ``raw / divider * multiplier``. Byte order and word order are LITTLE if they are not stated.
Gateway 3.8 ignores the orders of a single value, so an export states the order of the device only. Bits of a register are not
converted, because gateway versions count them differently.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

from fieldtwin.descriptions.conversion import Exported, Imported, Loss, Settings, Source
from fieldtwin.descriptions.maps.documents import Document, Loc, parse_json
from fieldtwin.descriptions.maps.drafting import TABLE_OF_FUNCTION, Draft, choose
from fieldtwin.descriptions.maps.rendering import Abilities, exported, shorten, stated_endpoint
from fieldtwin.gateway.core.files.profile import BIT_TABLES, READ_FUNCTION, REGISTERS_OF, DeviceProfile, Tag

ABILITIES = Abilities(
    "ThingsBoard",
    keeps={"access", "poll"},
    types={"int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64", "string"},
    write_only=True,
)

_TYPES = {
    "16int": "int16", "16uint": "uint16", "32int": "int32", "32uint": "uint32", "64int": "int64", "64uint": "uint64",
    "32float": "float32", "64float": "float64", "string": "string", "bytes": "bytes",
}  # fmt: skip
_NAMES = {kind: name for name, kind in _TYPES.items()}
_BY_LENGTH = {
    "int": "int", "integer": "int", "long": "int", "uint": "uint", "float": "float", "double": "float",
}  # fmt: skip
"""Types whose size is determined by the number of registers."""
_ORDERS = {("BIG", "BIG"): "ABCD", ("BIG", "LITTLE"): "CDAB", ("LITTLE", "BIG"): "BADC", ("LITTLE", "LITTLE"): "DCBA"}
_SECTIONS = ("attributes", "timeseries", "attributeUpdates", "rpc")
_NAME_KEYS = ("tag", "key", "name")


def import_description(source: Source, settings: Settings) -> Imported:
    """Return the profile of one device of a connector's configuration. The setting ``select`` selects it."""
    document = parse_json(source)
    devices = list(_devices(document))
    labels = [(_name(each, n), _unit(document, loc, each)) for n, (loc, each) in enumerate(devices, 1)]
    index = choose(labels, settings.get("select", ""), document.path)
    loc, device = devices[index]
    draft = Draft(document, labels[index][0], "ThingsBoard's Modbus connector", settings)
    _import_device(document, loc, device, labels[index][1], draft)
    for section in _SECTIONS:
        for place, entry, name in _entries(document, loc, device, section, draft):
            _import_entry(document, place, entry, name, section, device, draft)
    return draft.imported()


def _name(device: Mapping[str, Any], n: int) -> str:
    return str(device.get("deviceName") or device.get("name") or f"device{n}")


def _unit(document: Document, loc: Loc, device: Mapping[str, Any]) -> int:
    return document.integer(device.get("unitId", 1), (*loc, "unitId"), "`unitId`", 0, 255)


def _devices(document: Document) -> Iterator[tuple[Loc, dict[str, Any]]]:
    """Yield the devices of both layouts. A device of the older layout inherits the connection of its server."""
    data = document.mapping(document.data, (), "the configuration")
    if "configurationJson" in data:  # as the gateway stores it, and as ThingsBoard exports it
        data = document.mapping(data["configurationJson"], ("configurationJson",), "`configurationJson`")
        outer: Loc = ("configurationJson",)
    else:
        outer = ()
    if "master" in data:
        master = document.mapping(data["master"], (*outer, "master"), "`master`")
        yield from document.entries(master.get("slaves"), (*outer, "master", "slaves"), "`slaves`")
    elif "server" in data:
        server = document.mapping(data["server"], (*outer, "server"), "`server`")
        common = {key: value for key, value in server.items() if key not in ("devices", "name")}
        for loc, device in document.entries(server.get("devices"), (*outer, "server", "devices"), "`devices`"):
            yield loc, common | device
    elif "slaves" in data:
        yield from document.entries(data["slaves"], (*outer, "slaves"), "`slaves`")
    else:
        raise document.error((), "the file has no `master`", expected="`master: {slaves}` or `server: {devices}`")


def _import_device(document: Document, loc: Loc, device: Mapping[str, Any], unit: int, draft: Draft) -> None:
    draft.factory(unit=unit)
    if device.get("type") == "serial" or "baudrate" in device:
        draft.serial(loc, device, usual_rate=19200)
    draft.note("key host", "address of the device", "an endpoint belongs in the system file")
    kept = {"unitId", "deviceName", "byteOrder", "wordOrder", "host", "port", "type", *_SECTIONS}
    kept |= {"baudrate", "bytesize", "stopbits", "parity", "method"}
    for key in device:
        if key not in kept:
            draft.lose(f"key {key}", f"`{key}`", "the profile has no equivalent")
    if "byteOrder" not in device and "wordOrder" not in device:
        draft.lose(
            "key byteOrder", "stated byte order", "the file has none; the gateway's usual order LITTLE was taken"
        )


def _entries(
    document: Document, loc: Loc, device: Mapping[str, Any], section: str, draft: Draft
) -> Iterator[tuple[Loc, dict[str, Any], str]]:
    """Yield the entries of a section with their names. Older files have an object of methods in ``rpc``."""
    value = device.get(section)
    if isinstance(value, dict):
        for name, entry in value.items():
            if isinstance(entry, dict) and "address" in entry:
                yield (*loc, section, name), entry, name
            else:
                draft.lose(f"{section} {name}", "the entry", "it names no register")
        return
    for place, entry in document.entries(value, (*loc, section), f"`{section}`"):
        name = next((str(entry[key]) for key in _NAME_KEYS if entry.get(key)), "")
        yield place, entry, document.text(name, (*place, "tag"), "`tag`")


def _import_entry(
    document: Document,
    loc: Loc,
    entry: Mapping[str, Any],
    name: str,
    section: str,
    device: Mapping[str, Any],
    draft: Draft,
) -> None:
    code = document.integer(entry.get("functionCode", 3), (*loc, "functionCode"), "`functionCode`", 1, 127)
    if code not in TABLE_OF_FUNCTION:
        raise document.error((*loc, "functionCode"), "`functionCode`", expected="1 to 6, 15 or 16", got=str(code))
    table, address = TABLE_OF_FUNCTION[code], _address(document, loc, entry, name, draft)
    if address is None:
        return
    if table in BIT_TABLES and _count(document, loc, entry) > 1:
        draft.lose(f"{section} {name}", "all bits after the first", "a tag is one bit")
    fields: dict[str, Any] = {"access": "wo" if code in (5, 6, 15, 16) else None}
    if section == "attributes":
        fields["poll"] = "attributes"
    if table not in BIT_TABLES:
        found = _register_fields(document, loc, entry, name, device, draft)
        if found is None:
            return
        fields |= found
    if "reportStrategy" in entry:
        draft.lose(f"{section} {name}", "`reportStrategy`", "the profile has no equivalent")
    draft.add(loc, name, table, address, **fields)


def _address(document: Document, loc: Loc, entry: Mapping[str, Any], name: str, draft: Draft) -> int | None:
    """Return the address of an entry; None if it is a range, which newer gateways read as several values."""
    value = entry.get("address")
    if isinstance(value, str) and ("-" in value or "," in value):
        draft.lose(name, "the entry", f"its addresses {value!r} are a range of registers")
        return None
    return document.integer(value, (*loc, "address"), "`address`", 0, 65535)


def _count(document: Document, loc: Loc, entry: Mapping[str, Any]) -> int:
    key = next((k for k in ("objectsCount", "registerCount", "registersCount") if k in entry), "objectsCount")
    return document.integer(entry.get(key, 1), (*loc, key), f"`{key}`", 1, 125)


def _register_fields(
    document: Document, loc: Loc, entry: Mapping[str, Any], name: str, device: Mapping[str, Any], draft: Draft
) -> dict[str, Any] | None:
    """Return the type, order and scale of a tag, or None if a profile cannot hold the value."""
    stated, count = str(entry.get("type", "")).lower(), _count(document, loc, entry)
    order = _order(document, loc, entry, device)
    if stated in ("bit", "bits"):
        draft.lose(name, "the bit", "gateway versions count the bits differently; the tag is the whole register")
        return {}
    if stated in ("8int", "8uint", "16float"):
        draft.lose(name, "the tag", f"a profile has no type {stated}")
        return None
    kind = _TYPES.get(stated) or f"{_BY_LENGTH.get(stated, '')}{16 * count}"
    if kind not in {*_NAMES}:
        usual = ", ".join([*_TYPES, *_BY_LENGTH, "bits"])
        raise document.error(
            (*loc, "type"), f"the type of {name!r}", expected=usual, got=f"{stated} of {count} registers"
        )
    fields: dict[str, Any] = {"type": kind, "order": None if order == "ABCD" else order}
    if kind in ("string", "bytes"):
        return {"type": kind, "registers": count}  # the gateway does not reorder text
    if REGISTERS_OF[kind] == 1:
        fields["order"] = "BADC" if order in ("BADC", "DCBA") else None
    divider = document.number(entry.get("divider", 1), (*loc, "divider"), "`divider`")
    if not divider:
        raise document.error((*loc, "divider"), "`divider`", expected="a number other than 0")
    multiplier = document.number(entry.get("multiplier", 1), (*loc, "multiplier"), "`multiplier`")
    if divider != 1 and multiplier != 1:
        draft.lose(
            name,
            "certainty of the scale",
            "newer gateways ignore `multiplier` if there is a `divider`; both were taken",
        )
    fields["scale"] = multiplier / divider if multiplier != divider else None
    if isinstance(variants := entry.get("variants"), dict):
        fields["values"] = {int(key): str(text) for key, text in variants.items() if re.fullmatch(r"-?[0-9]{1,9}", key)}
    return fields


def _order(document: Document, loc: Loc, entry: Mapping[str, Any], device: Mapping[str, Any]) -> str:
    found = []
    for key in ("byteOrder", "wordOrder"):
        value = str(entry.get(key) or device.get(key) or "LITTLE").upper()
        found.append(document.choice(value, (*loc, key), f"`{key}`", ("BIG", "LITTLE")))
    return _ORDERS[found[0], found[1]]


def export_description(profile: DeviceProfile, settings: Settings) -> Exported:
    """Return a connector's configuration. Settings: ``endpoint``.

    A tag of the poll group ``attributes`` becomes an attribute, and all others time series. A tag that may be written, unless its
    write is dangerous, also becomes an attribute update.
    """
    losses: list[Loss] = []
    found, serial = stated_endpoint(profile, settings.get("endpoint", ""), losses)
    form = profile.form
    slave: dict[str, Any] = {}
    if found.is_serial:
        slave |= {"type": "serial", "method": found.scheme, "port": found.path, "baudrate": serial.baudrate}
        slave |= {"bytesize": serial.data_bits, "parity": serial.parity, "stopbits": serial.stop_bits}
    else:
        framed = found.scheme == "rtu+tcp"
        slave |= {"host": found.host, "port": found.port, "type": "udp" if found.scheme == "udp" else "tcp"}
        slave["method"] = "rtu" if framed else "socket"
    slave |= {"unitId": form.factory.unit, "deviceName": profile.name, "deviceType": "default", "timeout": 35}
    tags = list(exported(profile, ABILITIES, losses))
    order = _common_order(tags)
    byte_order, word_order = next(pair for pair, name in _ORDERS.items() if name == order)
    slave |= {"byteOrder": byte_order, "wordOrder": word_order, "retries": 3, "pollPeriod": 5000}
    slave |= {key: [] for key in _SECTIONS}
    for tag in tags:
        if not _fits(tag, order):
            losses.append(
                Loss(f"tag {tag.name}", "the tag", f"ThingsBoard reads all values of a device in the order {order}")
            )
            continue
        if tag.poll not in ("values", "attributes"):
            losses.append(Loss(f"tag {tag.name}", f"poll group {tag.poll}", "it becomes a time series"))
        entry = _entry(tag)
        if tag.readable:
            slave["attributes" if tag.poll == "attributes" else "timeseries"].append(entry)
        if tag.danger and tag.writable:
            losses.append(Loss(f"tag {tag.name}", "write access", "its write is dangerous"))
        elif tag.writable:
            slave["attributeUpdates"].append(entry | {"functionCode": _write_function(tag)})
    text = json.dumps({"master": {"slaves": [slave]}}, indent=2, ensure_ascii=False)
    return Exported((text + "\n").encode(), tuple(losses))


def _common_order(tags: list[Tag]) -> str:
    """Return the byte order of most values of several registers, or of most values if all have one register."""
    long = [tag.order for tag in tags if tag.type not in ("bool", "string") and tag.registers.count > 1]
    found = Counter(long or [tag.order for tag in tags if tag.type not in ("bool", "string")])
    return found.most_common(1)[0][0] if found else "ABCD"


def _fits(tag: Tag, order: str) -> bool:
    """Return whether the gateway decodes a tag correctly if its device has this order. It never reorders text."""
    if tag.type == "bool":
        return True
    if tag.type == "string":
        return tag.order in ("ABCD", "CDAB")
    swapped = ("BADC", "DCBA")
    return tag.order == order or (tag.registers.count == 1 and (tag.order in swapped) == (order in swapped))


def _write_function(tag: Tag) -> int:
    return 5 if tag.type == "bool" else 6 if tag.registers.count == 1 else 16


def _entry(tag: Tag) -> dict[str, Any]:
    at = tag.registers
    kind = "bits" if tag.type == "bool" else _NAMES[tag.type]
    entry: dict[str, Any] = {"tag": tag.name, "type": kind, "functionCode": READ_FUNCTION[at.table]}
    entry |= {"objectsCount": at.count, "address": at.address}
    if tag.type == "bool":
        return entry | {"bitTargetType": "bool"}
    if tag.scale != 1:
        inverse = 1 / tag.scale
        if inverse.is_integer() and 1 / inverse == tag.scale:
            entry["divider"] = shorten(inverse)
        else:
            entry["multiplier"] = shorten(tag.scale)
    return entry
