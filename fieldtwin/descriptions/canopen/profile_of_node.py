"""Make a profile from the description of a CANopen node. The EDS stays the object dictionary; the profile gives objects tags."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from math import isfinite
from typing import Any

from fieldtwin.descriptions.canopen.node import NodeDescription, NodeValue, mapped_words
from fieldtwin.descriptions.canopen.tag_names import TYPE_CODES, tag_names, type_name
from fieldtwin.descriptions.conversion import Loss, Settings, Source, whole_setting
from fieldtwin.descriptions.profile_text import printable
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.profile import INTEGER_RANGES
from fieldtwin.gateway.core.files.profile_schema import ProfileForm
from fieldtwin.gateway.devices.data_sheet import TAG_TYPES
from fieldtwin.gateway.protocols.canopen.eds.values import read_limit
from fieldtwin.gateway.protocols.canopen.pdo.mapping import PdoEntry

IDENTITY = 0x1018
_APPLICATION = range(0x2000, 0xA000)
_MAPPINGS = (range(0x1600, 0x1800), range(0x1A00, 0x1C00))
MAX_TAGS = 5000
"""The most tags of a profile that is made from a description; a larger one is refused with a hint to ``--set objects=pdo``."""

Chosen = Callable[[NodeValue, frozenset[tuple[int, int]]], bool]
CHOICES: Mapping[str, Chosen] = {
    "application": lambda v, _: v.index in _APPLICATION or v.index == IDENTITY,
    "pdo": lambda v, mapped: (v.index, v.subindex) in mapped,
    "all": lambda v, _: True,
}


def profile_of_node(
    node: NodeDescription, eds_name: str, title: str, source: Source, settings: Settings
) -> tuple[ProfileForm, tuple[Loss, ...]]:
    """Return the profile and what it does not have. `eds_name` is the file of its object dictionary, `title` the format.

    Raises `UsageError` for a setting, `FileInvalid` if no object can be a tag.
    """
    node_id = whole_setting(settings, "node", 1, 127) or node.node_id
    mapped = frozenset(mapped_objects(node, node_id or 1))
    losses: list[Loss] = []
    taken = [(parent, v) for parent, v in _chosen(node, mapped, settings) if _fits(v, losses)]
    if not taken:
        raise FileInvalid(
            "no object becomes a tag",
            path=str(source.path),
            expected="objects from 2000h to 9FFFh",
            hint="--set objects=all",
        )
    if len(taken) > MAX_TAGS:
        raise UsageError(
            f"{len(taken)} objects would become tags", expected=f"at most {MAX_TAGS}", hint="--set objects=pdo"
        ).at(str(source.path))
    names = tag_names([(v.index, v.subindex, parent, v.name) for parent, v in taken])
    form = {
        "device": settings.get("device") or _device(node, source),
        "source": printable(f"{title} {source.path.name}"),
        "protocol": "canopen",
        "factory": {} if node_id is None else {"node": node_id},
        "eds": eds_name,
        "identify": [
            {"tag": n} for n, (_, v) in zip(names, taken, strict=True) if (v.index, v.subindex) == (IDENTITY, 4)
        ],
        "tags": {name: _tag(v, mapped, losses) for name, (_, v) in zip(names, taken, strict=True)},
    }
    return _form(form), tuple(losses)


def mapped_objects(node: NodeDescription, node_id: int) -> Iterator[tuple[int, int]]:
    """Yield index and subindex of the objects that the PDOs of the node carry."""
    for each in node.objects:
        if not any(each.index in area for area in _MAPPINGS):
            continue
        for word in mapped_words(each, node_id):
            entry = PdoEntry.from_word(word)
            if entry.index:
                yield entry.index, entry.subindex


def _form(stated: dict[str, Any]) -> ProfileForm:
    try:
        return ProfileForm.model_validate(stated)
    except ValueError as e:  # of all values only the name of the device comes from the user as it is
        raise UsageError(
            "cannot use --set device", expected="MAKER/TYPE in lower case, such as acme/t-1000", got=stated["device"]
        ) from e


def _chosen(
    node: NodeDescription, mapped: frozenset[tuple[int, int]], settings: Settings
) -> Iterator[tuple[str, NodeValue]]:
    """Yield the values that become tags, with the names of their objects. The number of entries does not become a tag."""
    wanted = settings.get("objects", "application")
    if wanted not in CHOICES:
        raise UsageError(f"cannot use --set objects={wanted}", expected=", ".join(CHOICES))
    for each in node.objects:
        for v in each.values:
            if (each.is_single or v.subindex) and CHOICES[wanted](v, mapped):
                yield each.name, v


def _fits(value: NodeValue, losses: list[Loss]) -> bool:
    """Return whether a profile has the type of the value; otherwise note the loss."""
    if value.type_code in TAG_TYPES:
        return True
    kind = type_name(value.type_code)
    losses.append(
        Loss(f"object {value.place}", f"its tag, of type {kind}", "a profile has no such type; the EDS has the object")
    )
    return False


def _tag(value: NodeValue, mapped: frozenset[tuple[int, int]], losses: list[Loss]) -> dict[str, Any]:
    kind = TAG_TYPES[value.type_code]
    tag: dict[str, Any] = {"object": f"{value.index:04X}:{value.subindex:02X}", "type": kind}
    if value.access in ("rw", "rwr", "rww"):
        tag["access"] = "rw"
    elif value.access == "wo":
        tag["access"] = "wo"
    if value.index == IDENTITY:
        tag["poll"] = "identity"
    elif (value.index, value.subindex) not in mapped:
        tag["poll"] = "parameters"
    if value.unit:
        tag["unit"] = printable(value.unit)
    scale = _factor(value, losses)
    if scale != 1.0:
        tag["scale"] = scale
    offset = _finite(value.offset, 0.0)
    if offset is None:
        losses.append(Loss(f"object {value.place}", f"the offset {printable(value.offset)[:40]}", "it is not a number"))
    if offset:
        tag["offset"] = offset
    if value.names:
        tag["values"] = {number: printable(name) for number, name in value.names}
    limits = _range(value, kind, scale, offset or 0.0, losses)
    if limits is not None:
        tag["range"] = limits
    if value.remark:
        tag["description"] = printable(value.remark)
    return tag


def _factor(value: NodeValue, losses: list[Loss]) -> float:
    """Return the scale of a value. A factor that is not a positive or negative number is lost."""
    factor = _finite(value.factor, 1.0)
    if not factor:
        losses.append(Loss(f"object {value.place}", f"the factor {printable(value.factor)[:40]}", "it is not a number"))
        return 1.0
    return factor


def _finite(text: str, otherwise: float) -> float | None:
    """Return the number in `text`, `otherwise` if it is empty, None if it is not a finite number."""
    try:
        number = float(text or otherwise)
    except ValueError:
        return None
    return number if isfinite(number) else None


def _range(value: NodeValue, kind: str, scale: float, offset: float, losses: list[Loss]) -> tuple[float, float] | None:
    """Return the limits in engineering units; None if the description has no limits, or only those of the type.

    An integer with one limit gets the limit of its type for the other. A float with one limit loses it.
    """
    if not value.low and not value.high:
        return None
    ends = INTEGER_RANGES.get(kind)
    if ends is None and not (value.low and value.high):
        losses.append(Loss(f"object {value.place}", "its limit", "a profile states both limits or none"))
        return None
    code = TYPE_CODES[kind]
    stated = read_limit(code, value.low), read_limit(code, value.high)
    if None in stated and ends is None:
        return None
    low = stated[0] if stated[0] is not None or ends is None else ends[0]
    high = stated[1] if stated[1] is not None or ends is None else ends[1]
    if (low, high) == ends or low is None or high is None:
        return None
    first, last = sorted((_short(low * scale + offset), _short(high * scale + offset)))
    return first, last


def _short(number: float) -> float:
    """Return a whole number as an int, and another one with 12 digits, which removes the noise of binary fractions."""
    return int(number) if number == int(number) else float(f"{number:.12g}")


def _device(node: NodeDescription, source: Source) -> str:
    """Return MAKER/TYPE from the names of vendor and product, or from the name of the file."""
    maker = _word(node.device.get("VendorName", "")) or "imported"
    return f"{maker}/{_word(node.device.get('ProductName', '')) or _word(source.path.stem) or 'node'}"


def _word(text: str) -> str:
    kept = "".join(c if c.isascii() and c.isalnum() else "-" for c in text.lower())
    return "-".join(part for part in kept.split("-") if part)[:60].strip("-")
