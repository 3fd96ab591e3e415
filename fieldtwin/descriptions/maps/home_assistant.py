"""Home Assistant's integration ``modbus`` (YAML): sensors, binary sensors and switches of one device on one hub.

Its addresses are those that are sent, from 0, and a value is ``scale * raw + offset`` (documentation of the integration). The
file may be a whole ``configuration.yaml``, a package, or the list of hubs that ``modbus: !include`` names.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import yaml

from fieldtwin.descriptions.conversion import Exported, Imported, Loss, Settings, Source
from fieldtwin.descriptions.maps.documents import Document, Loc, Tagged, parse_yaml
from fieldtwin.descriptions.maps.drafting import Draft, choose
from fieldtwin.descriptions.maps.rendering import Abilities, exported, shorten, stated_endpoint
from fieldtwin.gateway.core.files.profile import REGISTERS_OF, DeviceProfile, Table, Tag

ABILITIES = Abilities(
    "Home Assistant",
    keeps={"unit", "offset", "sentinels", "access"},
    types={"int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64", "string"},
)

UNKNOWN_UNIT = 1
"""The unit ID of an entity whose configuration has a reference to a different file, such as ``!secret``, in its place."""

_HUB_TYPES = {"tcp": "tcp", "udp": "udp", "rtuovertcp": "rtu+tcp", "serial": "rtu"}
_INPUTS: dict[str, Table] = {"holding": "holding", "input": "input", "coil": "coil", "discrete_input": "discrete"}
_INPUT_NAMES = {table: name for name, table in _INPUTS.items()}
_TYPES = {
    "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64", "string"
}  # fmt: skip
_OLD_TYPES = {
    "int": ("int16", "int32", "", "int64"), "uint": ("uint16", "uint32", "", "uint64"), "float": ("", "float32", "", "float64"),
}  # fmt: skip
"""Types of Home Assistant before 2022, by ``count``."""
_SWAPS = {"none": "ABCD", "byte": "BADC", "word": "CDAB", "word_byte": "DCBA"}
_STRUCTURES = {
    "h": "int16", "H": "uint16", "i": "int32", "I": "uint32", "l": "int32", "L": "uint32", "q": "int64", "Q": "uint64",
    "f": "float32", "d": "float64",
}  # fmt: skip
_PLATFORMS = ("sensors", "binary_sensors", "switches")
_WITHOUT_TAGS = ("climates", "covers", "fans", "lights")
_DISPLAY = (
    "device_class", "state_class", "unique_id", "precision", "scan_interval", "lazy_error_count", "zero_suppress", "icon",
)  # fmt: skip
"""Keys that determine how Home Assistant shows or polls a value."""


def import_description(source: Source, settings: Settings) -> Imported:
    """Return the profile of one device of a configuration. The setting ``select`` selects it: hub name, unit ID, or both."""
    document = parse_yaml(source)
    devices: dict[tuple[str, int], list[tuple[Loc, str, dict[str, Any]]]] = {}
    hubs: dict[str, tuple[Loc, dict[str, Any]]] = {}
    for n, (loc, hub) in enumerate(_hubs(document), 1):
        name = str(hub.get("name") or f"hub{n}")
        hubs.setdefault(name, (loc, hub))
        for platform in (*_PLATFORMS, *_WITHOUT_TAGS):
            if isinstance(hub.get(platform), Tagged):
                continue
            for place, entity in document.entries(hub.get(platform), (*loc, platform), f"`{platform}`"):
                devices.setdefault((name, _unit(document, place, entity)), []).append((place, platform, entity))
    labels = list(devices)
    index = choose(labels, settings.get("select", ""), document.path)
    name, unit = labels[index]
    draft = Draft(document, name, "Home Assistant's modbus integration", settings)
    draft.factory(unit=unit)
    if any(
        isinstance(each.get(key), Tagged)
        for _, _, each in devices[labels[index]]
        for key in ("slave", "device_address")
    ):
        draft.lose("key slave", "unit ID", f"it is not in this file; {UNKNOWN_UNIT} was taken")
    _import_hub(document, *hubs[name], draft)
    for place, platform, entity in devices[labels[index]]:
        if platform in _WITHOUT_TAGS:
            label = str(entity.get("name") or platform)
            draft.lose(f"{platform} {label}", "the entity", "a profile has tags, and no entity of several registers")
        else:
            _import_entity(document, place, platform, entity, draft)
    return draft.imported()


def _hubs(document: Document) -> Iterator[tuple[Loc, dict[str, Any]]]:
    """Yield each hub of a configuration, a package, or a list of hubs."""
    data = document.data
    loc: Loc = ()
    if isinstance(data, dict) and "modbus" in data:
        data, loc = data["modbus"], ("modbus",)
    if isinstance(data, Tagged):
        raise document.error(loc, f"the hubs are in a different file: {data.tag} {data.text}", hint="import that file")
    if isinstance(data, dict) and isinstance(data.get("homeassistant"), dict):
        packages = data["homeassistant"].get("packages")
        if isinstance(packages, dict):
            for name, package in packages.items():
                if isinstance(package, dict) and "modbus" in package:
                    inner = ("homeassistant", "packages", str(name), "modbus")
                    yield from document.entries(_listed(package["modbus"]), inner, "`modbus`")
            return
    if isinstance(data, dict) and not loc and not {"type", *_PLATFORMS} & set(data):
        raise document.error((), "the file has no `modbus:`", expected="`modbus:` with a list of hubs")
    yield from document.entries(_listed(data), loc, "`modbus`")


def _listed(value: object) -> object:
    return [value] if isinstance(value, dict) else value


def _unit(document: Document, loc: Loc, entity: Mapping[str, Any]) -> int:
    key = "device_address" if "device_address" in entity else "slave"
    value = entity.get(key, 1)
    if isinstance(value, Tagged):
        return UNKNOWN_UNIT
    return document.integer(value, (*loc, key), f"`{key}`", 0, 255)


def _import_hub(document: Document, loc: Loc, hub: Mapping[str, Any], draft: Draft) -> None:
    kind = hub.get("type", "tcp")
    if kind == "serial":
        draft.serial(loc, hub)
    document.choice(kind, (*loc, "type"), "`type`", _HUB_TYPES)
    draft.note("key host", "address of the hub", "an endpoint belongs in the system file")
    for key in ("timeout", "delay", "message_wait_milliseconds", "retries"):
        if key in hub:
            draft.lose(f"key {key}", f"`{key}`", "the profile has no equivalent")
    for platform in (*_PLATFORMS, *_WITHOUT_TAGS):
        if isinstance(value := hub.get(platform), Tagged):
            draft.lose(f"key {platform}", f"all {platform}", f"they are in a different file: {value.tag} {value.text}")


def _import_entity(document: Document, loc: Loc, platform: str, entity: Mapping[str, Any], draft: Draft) -> None:
    name = document.text(entity.get("name"), (*loc, "name"), "`name`")
    place = f"{platform} {name}"
    address = document.integer(entity.get("address"), (*loc, "address"), "`address`", 0, 65535)
    table = _table(document, loc, platform, entity)
    fields: dict[str, Any] = {}
    if shown := [key for key in _DISPLAY if key in entity]:
        draft.lose(place, ", ".join(shown), "Home Assistant's display and polling; the profile has no equivalent")
    if platform == "switches":
        fields["access"] = "rw" if "verify" in entity else "wo"
        verify = entity.get("verify")
        if isinstance(verify, dict) and verify.get("address", address) != address:
            draft.lose(place, "address of its state", "a tag is read and written at one address")
            fields["access"] = "wo"
        if table == "holding":
            on = document.integer(entity.get("command_on", 1), (*loc, "command_on"), "`command_on`", 0, 65535)
            off = document.integer(entity.get("command_off", 0), (*loc, "command_off"), "`command_off`", 0, 65535)
            fields["values"] = {off: "off", on: "on"}
    elif table in ("holding", "input"):
        if platform == "sensors":
            found = _sensor_fields(document, loc, entity, place, draft)
            if found is None:
                return
            fields |= found
        else:
            fields["bits"] = (0, 0)  # the integration shows the lowest bit of each register
    copies = entity.get("virtual_count", entity.get("slave_count", 0))
    more = document.integer(copies, (*loc, "virtual_count"), "`virtual_count`", 0, 1000)
    step = fields.get("registers") or REGISTERS_OF.get(fields.get("type") or "uint16", 1)
    for i in range(more + 1):
        draft.add(loc, f"{name}_{i}" if i else name, table, address + i * step, **fields)


def _table(document: Document, loc: Loc, platform: str, entity: Mapping[str, Any]) -> Table:
    key = "write_type" if platform == "switches" else "input_type"
    kind = entity.get(key, "coil" if platform == "binary_sensors" else "holding")
    kind = {"coils": "coil", "holdings": "holding"}.get(str(kind), str(kind))
    return _INPUTS[document.choice(kind, (*loc, key), f"`{key}`", _INPUTS)]


def _sensor_fields(
    document: Document, loc: Loc, entity: Mapping[str, Any], place: str, draft: Draft
) -> dict[str, Any] | None:
    """Return the fields of a tag, or None if a profile cannot hold the value."""
    stated = kind = str(entity.get("data_type", "int16"))
    count = document.integer(entity.get("count") or 1, (*loc, "count"), "`count`", 1, 125)
    swap = entity.get("swap", "none")
    swap = "none" if swap in (False, None) else swap  # an older file may have `swap: false`
    order = _SWAPS[document.choice(swap, (*loc, "swap"), "`swap`", _SWAPS)]
    if kind in _OLD_TYPES:
        kind = _OLD_TYPES[kind][count - 1] if count <= 4 else ""
    if kind == "custom":
        structure = str(entity.get("structure", "")).strip()
        kind = _STRUCTURES.get(structure.lstrip(">!"), "")
        if structure.startswith("<") or not kind or REGISTERS_OF[kind] != count:
            draft.lose(place, "the tag", f"its structure {structure!r} is not a single value of a profile's type")
            return None
    if kind not in _TYPES:
        if kind == "float16" or stated in _OLD_TYPES:
            draft.lose(place, "the tag", f"a profile has no type {stated} of {count} registers")
            return None
        raise document.error((*loc, "data_type"), "`data_type`", expected=", ".join(sorted(_TYPES)), got=repr(kind))
    fields: dict[str, Any] = {"type": kind, "order": None if order == "ABCD" else order}
    if kind == "string":
        fields["registers"] = count
        return fields
    for key, usual in (("scale", 1.0), ("offset", 0.0)):
        number = document.number(entity.get(key, usual), (*loc, key), f"`{key}`")
        fields[key] = number if number != usual else None
    fields["unit"] = str(entity["unit_of_measurement"]) if entity.get("unit_of_measurement") else None
    if "nan_value" in entity:
        text = str(entity["nan_value"])
        base = text if text.lower().startswith("0x") or not any(c in "abcdefABCDEF" for c in text) else f"0x{text}"
        fields["sentinels"] = [document.integer(base, (*loc, "nan_value"), "`nan_value`", 0, (1 << 32) - 1)]
    for key in ("min_value", "max_value"):
        if key in entity:
            draft.lose(
                place, f"`{key}`", "Home Assistant limits what it shows; a profile's range marks a value as uncertain"
            )
    return fields


def export_description(profile: DeviceProfile, settings: Settings) -> Exported:
    """Return a ``modbus:`` section. Settings: ``endpoint``.

    A coil that may be written becomes a switch that reads its state back. All other values are sensors, because the integration
    cannot write them.
    """
    losses: list[Loss] = []
    found, serial = stated_endpoint(profile, settings.get("endpoint", ""), losses)
    hub: dict[str, Any] = {"name": profile.name.replace("/", "_")}
    if found.is_serial:
        hub |= {"type": "serial", "port": found.path, "baudrate": serial.baudrate, "bytesize": serial.data_bits}
        hub |= {"method": found.scheme, "parity": serial.parity, "stopbits": serial.stop_bits}
    else:
        kinds = {scheme: kind for kind, scheme in _HUB_TYPES.items()}
        hub |= {"type": kinds[found.scheme], "host": found.host, "port": found.port}
    if profile.form.timing.connect_pause_ms:
        hub["delay"] = -(-profile.form.timing.connect_pause_ms // 1000)
    for tag in exported(profile, ABILITIES, losses):
        platform, entity = _entity(_with_one_sentinel(tag, losses), profile.form.factory.unit, losses)
        hub.setdefault(platform, []).append(entity)
    text = yaml.safe_dump({"modbus": [hub]}, sort_keys=False, allow_unicode=True, width=120)
    head = f"# {profile.name}: written by fieldtwin from a device profile.\n"
    return Exported((head + text).encode(), tuple(losses))


def _with_one_sentinel(tag: Tag, losses: list[Loss]) -> Tag:
    """Return the tag with at most one sentinel, which `nan_value` can hold, and add a loss for the others."""
    kept = tuple(s for s in tag.sentinels if 0 <= s < 1 << 32)[:1]
    if len(kept) < len(tag.sentinels):
        losses.append(
            Loss(f"tag {tag.name}", "further values that mean that there is no value", "`nan_value` is one number")
        )
    return replace(tag, sentinels=kept)


def _entity(tag: Tag, unit: int, losses: list[Loss]) -> tuple[str, dict[str, Any]]:
    """Return the platform of a tag and its entity."""
    at = tag.registers
    entity: dict[str, Any] = {"name": tag.name, "slave": unit, "address": at.address}
    if at.table == "coil" and tag.writable and not tag.danger:
        return "switches", entity | {"write_type": "coil", "verify": {}}
    if tag.writable:
        why = "its write is dangerous" if tag.danger else "the integration writes coils only"
        losses.append(Loss(f"tag {tag.name}", "write access", why))
    entity["input_type"] = _INPUT_NAMES[at.table]
    if tag.type == "bool":
        return "binary_sensors", entity
    entity["data_type"] = tag.type
    if tag.type == "string":
        entity["count"] = at.count
    swap = next(name for name, order in _SWAPS.items() if order == tag.order)
    if at.count == 1 or tag.type == "string":  # the bytes within a register only
        swap = "byte" if tag.order in ("BADC", "DCBA") else "none"
    if swap != "none":
        entity["swap"] = swap
    if tag.type != "string":
        entity |= {"scale": shorten(tag.scale)} if tag.scale != 1 else {}
        entity |= {"offset": shorten(tag.offset)} if tag.offset else {}
        entity |= {"unit_of_measurement": tag.unit} if tag.unit else {}
        entity |= {"nan_value": tag.sentinels[0]} if tag.sentinels else {}
        if tag.type.startswith("float") or tag.scale != 1 or tag.offset:
            entity["precision"] = _precision(tag)
    return "sensors", entity


def _precision(tag: Tag) -> int:
    """Return the decimal places to show: those of the scale and the offset, or 3 for a float."""
    places = [len(f"{x:.9f}".rstrip("0").partition(".")[2]) for x in (tag.scale, tag.offset)]
    return max(*places, 3 if tag.type.startswith("float") else 0)
