"""SunSpec model definitions (JSON, as in the repository sunspec/models): the points of one model at a base address.

The base address is the register of the point ``ID``, as sent, from 0. Types, sizes and values that mean that a point is not
implemented are those of the SunSpec Device Information Model Specification 1.2.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from fieldtwin.descriptions.conversion import (
    Exported,
    Imported,
    Loss,
    Settings,
    Source,
    require_protocol,
    whole_setting,
)
from fieldtwin.descriptions.maps.documents import Document, Loc, parse_json
from fieldtwin.descriptions.maps.drafting import Draft, slug
from fieldtwin.descriptions.maps.rendering import Abilities, device_losses
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile, Tag
from fieldtwin.gateway.core.files.profile_schema import IdentifyForm

MAX_REGISTERS = 65_536
MAX_REPEAT = 100
"""The largest number of repetitions of a repeating group in one import."""
MAX_DEPTH = 10
MAX_READ = 125
"""The largest number of registers of one request (AP 6.3), and therefore of one tag."""

_COMMON_BASE, _USUAL_BASE = 40_002, 40_070
"""The usual addresses of the common model, after the marker "SunS" at 40000, and of the first model after it."""

_TYPES: dict[str, tuple[str, int, int | None]] = {
    "int16": ("int16", 1, 0x8000),
    "uint16": ("uint16", 1, 0xFFFF),
    "count": ("uint16", 1, None),
    "acc16": ("uint16", 1, 0),
    "enum16": ("uint16", 1, 0xFFFF),
    "bitfield16": ("uint16", 1, 0xFFFF),
    "pad": ("uint16", 1, 0x8000),
    "sunssf": ("int16", 1, 0x8000),
    "int32": ("int32", 2, 0x8000_0000),
    "uint32": ("uint32", 2, 0xFFFF_FFFF),
    "acc32": ("uint32", 2, 0),
    "enum32": ("uint32", 2, 0xFFFF_FFFF),
    "bitfield32": ("uint32", 2, 0xFFFF_FFFF),
    "ipaddr": ("uint32", 2, 0),
    "int64": ("int64", 4, 0x8000_0000_0000_0000),
    "uint64": ("uint64", 4, 0xFFFF_FFFF_FFFF_FFFF),
    "acc64": ("uint64", 4, 0),
    "bitfield64": ("uint64", 4, 0xFFFF_FFFF_FFFF_FFFF),
    "float32": ("float32", 2, None),
    "float64": ("float64", 4, None),
    "eui48": ("bytes", 4, None),
    "ipv6addr": ("bytes", 8, None),
    "string": ("string", 0, None),
}
"""The type of a tag, the number of registers, and the raw value of a point that is not implemented."""

_ABILITIES = Abilities("SunSpec", keeps={"identify"}, types=())


@dataclass
class _Reader:
    """The state of one import: the next address, and the names of scale factors that are known at this place."""

    document: Document
    draft: Draft
    repeat: int
    address: int
    scale_factors: list[dict[str, str]] = field(default_factory=list)


def import_description(source: Source, settings: Settings) -> Imported:
    """Return the profile of one model. Settings: ``base`` and ``repeat``, the number of repetitions of repeating groups."""
    document = parse_json(source)
    model = document.mapping(document.data, (), "the model")
    number = document.integer(model.get("id"), ("id",), "`id`", 1, 65535)
    group = document.mapping(model.get("group"), ("group",), "`group`")
    base, repeat = whole_setting(settings, "base", 0, 65535), whole_setting(settings, "repeat", 0, MAX_REPEAT)
    draft = Draft(document, f"sunspec-model-{number}", f"the SunSpec model {number}", settings)
    if base is None:
        base = _COMMON_BASE if number == 1 else _USUAL_BASE
        draft.lose("the model", "base address", f"the definition has none; {base} was taken (--set base=ADDRESS)")
    reader = _Reader(document, draft, 1 if repeat is None else repeat, base)
    _read_group(reader, ("group",), group, "", 0)
    found = draft.imported()
    identify = [IdentifyForm(tag="id", expect=number)] if "id" in found.profile.tags else []
    return replace(found, profile=found.profile.model_copy(update={"identify": identify}))


def _read_group(reader: _Reader, loc: Loc, group: Mapping[str, Any], prefix: str, depth: int) -> None:
    """Add the points of a group and of its inner groups, in the order in which they are transmitted."""
    if depth > MAX_DEPTH:
        raise reader.document.error(loc, "the groups are nested too deeply", expected=f"at most {MAX_DEPTH} levels")
    points = reader.document.entries(group.get("points"), (*loc, "points"), "`points`")
    names = {str(point.get("name")): prefix + (slug(str(point.get("name"))) or "point") for _, point in points}
    reader.scale_factors.append(names)
    for at, point in points:
        _read_point(reader, at, point, prefix)
    for at, inner in reader.document.entries(group.get("groups"), (*loc, "groups"), "`groups`"):
        name = slug(reader.document.text(inner.get("name"), (*at, "name"), "`name`")) or "group"
        for i in range(_repetitions(reader, at, inner, name)):
            _read_group(
                reader, at, inner, f"{prefix}{name}_{i + 1}_" if "count" in inner else f"{prefix}{name}_", depth + 1
            )
    reader.scale_factors.pop()


def _repetitions(reader: _Reader, loc: Loc, group: Mapping[str, Any], name: str) -> int:
    """Return how often a group occurs. A count of 0, or the name of a point, is only known from the device."""
    count = group.get("count", 1)
    if isinstance(count, int) and not isinstance(count, bool) and count > 0:
        return reader.document.integer(count, (*loc, "count"), "`count`", 1, MAX_REPEAT)
    if not isinstance(count, str) and count != 0:
        raise reader.document.error(
            (*loc, "count"), "`count`", expected="a number, or the name of a point", got=repr(count)
        )
    what = f"the point {count}" if isinstance(count, str) else "the length of the model"
    reader.draft.lose(
        f"group {name}",
        "number of repetitions",
        f"the device states it in {what}; {reader.repeat} was taken (--set repeat=N)",
    )
    return reader.repeat


def _read_point(reader: _Reader, loc: Loc, point: Mapping[str, Any], prefix: str) -> None:
    document, draft = reader.document, reader.draft
    name = document.text(point.get("name"), (*loc, "name"), "`name`")
    kind = document.choice(point.get("type"), (*loc, "type"), f"the type of the point {name!r}", _TYPES)
    tag_type, registers, missing = _TYPES[kind]
    size = document.integer(point.get("size", registers), (*loc, "size"), "`size`", 1, 1000)
    if registers and size != registers:
        raise document.error((*loc, "size"), f"the size of the point {name!r}", expected=str(registers), got=str(size))
    if reader.address + size > MAX_REGISTERS:
        raise document.error(loc, f"the point {name!r} exceeds the table", expected="registers up to 65535 as sent")
    if size > MAX_READ:
        draft.lose(f"point {name}", "the tag", f"one request reads at most {MAX_READ} registers")
        reader.address += size
        return
    place, tag = f"point {name}", prefix + (slug(name) or "point")
    text = ": ".join(str(each) for each in (name, point.get("label")) if each)
    fields: dict[str, Any] = {"type": tag_type, "description": text}
    fields["registers"] = size if tag_type in ("string", "bytes") else None
    fields["sentinels"] = [missing] if missing is not None else None
    fields["unit"] = str(point["units"]).strip() if point.get("units") else None
    fields["counter"] = True if kind.startswith("acc") else None
    fields["access"] = "rw" if point.get("access") == "RW" else None
    fields["poll"] = "identity" if point.get("static") == "S" else None
    fields |= _scale(reader, loc, point, place)
    if symbols := document.entries(point.get("symbols"), (*loc, "symbols"), "`symbols`"):
        if kind.startswith("bitfield"):
            draft.lose(place, "names of its bits", "the names of a tag are those of whole values")
        else:
            fields["values"] = {
                document.integer(each.get("value"), (*at, "value"), "`value`", 0, 0xFFFF_FFFF): str(each.get("name"))
                for at, each in symbols
            }
    for key in ("mandatory", "standards"):
        if key in point:
            draft.lose("the model", f"`{key}`", "the profile has no equivalent")
    draft.add(loc, tag, "holding", reader.address, **fields)
    reader.address += size


def _scale(reader: _Reader, loc: Loc, point: Mapping[str, Any], place: str) -> dict[str, Any]:
    """Return the scale of a point: a number, or the name of the tag that holds the power of ten."""
    factor = point.get("sf")
    if factor is None:
        return {}
    if not isinstance(factor, str):
        power = reader.document.integer(abs(factor) if isinstance(factor, int) else factor, (*loc, "sf"), "`sf`", 0, 10)
        return {"scale": float(f"1e{int(math.copysign(power, factor))}")} if power else {}
    found = next((names[factor] for names in reversed(reader.scale_factors) if factor in names), None)
    if found is None:
        raise reader.document.error(
            (*loc, "sf"), f"no point is called {factor!r}", expected="a number or a point's name"
        )
    if point.get("access") == "RW":
        reader.draft.lose(
            place, "writes through the gateway", "it does not write values that a different register scales"
        )
    return {"scale_by": found}


def export_description(profile: DeviceProfile, settings: Settings) -> Exported:
    """Return a model definition of the holding registers from the base address on.

    Settings: ``model``, its number; ``base``, the register of ``ID``; ``length``, the number of registers after ``L``. The points
    ``ID`` and ``L`` are written in any case. A register that no tag names becomes a point of type pad.
    """
    require_protocol(profile, "modbus", "SunSpec")
    number, base = whole_setting(settings, "model", 1, 65535), whole_setting(settings, "base", 0, 65535)
    length = whole_setting(settings, "length", 1, 65535)
    if number is None or base is None:
        raise UsageError(
            "a SunSpec model needs its number and its base address", expected="--set model=NUMBER --set base=ADDRESS"
        )
    losses = list(device_losses(profile.form, _ABILITIES))
    end = min(base + 2 + length if length is not None else MAX_REGISTERS, MAX_REGISTERS)
    header: list[dict[str, Any]] = [
        {"name": "ID", "type": "uint16", "size": 1, "value": number, "mandatory": "M", "static": "S"},
        {"name": "L", "type": "uint16", "size": 1, "mandatory": "M", "static": "S"},
    ]
    points = list(_points(profile, base + 2, end, losses))
    if not points:
        raise UsageError(f"{profile.name} has no holding register that a model at {base} can hold")
    total = sum(point["size"] for point in points)
    points += _pads(total, (end - base - 2 if length is not None else total) - total)
    group = {"name": f"model_{number}", "type": "group", "label": profile.name, "points": header + points}
    text = json.dumps({"id": number, "group": group}, indent=2, ensure_ascii=False)
    return Exported((text + "\n").encode(), tuple(losses))


def _pads(first: int, count: int) -> list[dict[str, Any]]:
    return [{"name": f"Pad{first + i}", "type": "pad", "size": 1} for i in range(count)]


def _points(profile: DeviceProfile, first: int, end: int, losses: list[Loss]) -> Iterator[dict[str, Any]]:
    """Yield the points from the address `first` on, without `end`."""
    factors = {tag.scale_by for tag in profile.tags.values() if tag.scale_by}
    inside = [
        tag for tag in profile.tags.values() if tag.registers.table == "holding" and tag.registers.address >= first - 2
    ]
    inside = [tag for tag in inside if tag.registers.end <= end]
    for tag in profile.tags.values():
        if tag not in inside:
            losses.append(Loss(f"tag {tag.name}", "the tag", "it is not in the registers of this model"))
    next_free = first
    for tag in sorted(inside, key=lambda each: each.registers.address):
        at = tag.registers
        if at.address < first:
            losses.append(Loss(f"tag {tag.name}", "the tag", "the model has the points ID and L there"))
            continue
        point, why = _point(tag, tag.name in factors, losses)
        if at.address < next_free:
            point, why = None, "a different tag has its registers"
        if point is None:
            losses.append(Loss(f"tag {tag.name}", "the tag", why))
            continue
        yield from _pads(next_free - first, at.address - next_free)
        yield point
        next_free = at.end


def _point(tag: Tag, is_factor: bool, losses: list[Loss]) -> tuple[dict[str, Any] | None, str]:
    """Return the point of a tag; or None, and the reason."""
    power = round(math.log10(tag.scale)) if tag.scale > 0 else 99
    if tag.secret:
        return None, "it is secret"
    if tag.order != "ABCD":
        return None, f"a SunSpec device is big endian, and the tag has the order {tag.order}"
    if tag.bits is not None:
        return None, "it is a part of a register"
    if tag.offset or float(f"1e{power}") != tag.scale or not -10 <= power <= 10:
        return None, f"SunSpec has neither an offset nor a scale of {tag.scale:g}"
    kind = _kind(tag, is_factor)
    if kind is None:
        return None, f"SunSpec has no type {tag.type} of {tag.registers.count} registers"
    point: dict[str, Any] = {"name": tag.name, "type": kind, "size": tag.registers.count}
    point |= {"sf": tag.scale_by} if tag.scale_by else {"sf": power} if power else {}
    point |= {"units": tag.unit} if tag.unit else {}
    point |= {"access": "RW"} if tag.writable and not tag.danger else {}
    if tag.writable and tag.danger:
        losses.append(Loss(f"tag {tag.name}", "write access", "its write is dangerous"))
    if tag.values:
        point["symbols"] = [{"name": name, "value": value} for value, name in tag.values]
    missing = _TYPES[kind][2]
    if tag.sentinels != (() if missing is None else (missing,)):
        why = (
            "a SunSpec type has one such value"
            if tag.sentinels
            else f"a {kind} is not implemented if it is {missing:X}h"
        )
        losses.append(Loss(f"tag {tag.name}", "values that mean that there is no value", why))
    for key, what in (("range", "permitted range"), ("nonvolatile", "mark as stored without power")):
        if getattr(tag, key):
            losses.append(Loss(f"tag {tag.name}", what, "SunSpec has no place for it"))
    if tag.poll not in ("values", "identity"):
        losses.append(Loss(f"tag {tag.name}", "poll group", "SunSpec has no groups"))
    return point | ({"static": "S"} if tag.poll == "identity" else {}), ""


def _kind(tag: Tag, is_factor: bool) -> str | None:
    """Return the type of a point for a tag, or None if SunSpec has none."""
    if tag.type == "bytes":
        return {4: "eui48", 8: "ipv6addr"}.get(tag.registers.count)
    if is_factor and tag.type == "int16":
        return "sunssf"
    if tag.type in ("uint16", "uint32", "uint64"):
        bits = tag.type.removeprefix("uint")
        if tag.counter:
            return f"acc{bits}"
        return f"enum{bits}" if tag.values and bits != "64" else tag.type
    return tag.type if tag.type in _TYPES else None
