"""Make the description of a CANopen node from a profile: its object dictionary with the tags' limits, units and scales."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace

from fieldtwin.descriptions.canopen.eds_reader import read_eds
from fieldtwin.descriptions.canopen.node import VAR, NodeDescription, NodeObject, NodeValue
from fieldtwin.descriptions.canopen.tag_names import TYPE_CODES, tag_names, type_name
from fieldtwin.descriptions.conversion import Loss, losses_of_keys, require_protocol
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.input_file import read_input, reading
from fieldtwin.gateway.core.files.profile import INTEGER_RANGES, DeviceProfile, Tag
from fieldtwin.gateway.devices.data_sheet import TAG_TYPES
from fieldtwin.gateway.protocols.canopen.eds.dictionary import MAX_EDS_BYTES

NO_PLACE = "the format describes objects, not what a gateway does with them"
_NO_PLACE_FOR_IT = "the format has no place for it"
_KEYS = {
    "source": _NO_PLACE_FOR_IT,
    "timing": NO_PLACE,
    "identify": NO_PLACE,
    "commands": NO_PLACE,
    "behaviours": NO_PLACE,
    "trigger": NO_PLACE,
    "sampled": NO_PLACE,
    "effects": NO_PLACE,
}
_WRITABLE = ("rw", "rwr", "rww")
OFFSET, VALUE_NAMES = "its offset", "the names of its values"


def node_of_profile(
    profile: DeviceProfile, title: str, has: Collection[str] = ()
) -> tuple[NodeDescription, list[Loss]]:
    """Return the description and what it does not have of the profile. `title` names the format, for messages.

    `has` are properties of a tag that this format has, but others do not: `OFFSET` and `VALUE_NAMES`.

    Raises `UsageError` if the profile is not of a CANopen device, `FileInvalid` if its EDS cannot be read.
    """
    require_protocol(profile, "canopen", title)
    node, repairs = read_profile_eds(profile)
    losses = [Loss("the EDS", f"repaired: {repair}", "the result has the repaired value") for repair in repairs]
    losses += losses_of_keys(profile, _KEYS)
    by_object = {tag.object: tag for tag in profile.tags.values() if tag.object is not None}
    known = {(v.index, v.subindex) for v in node.values()}
    losses += _names_lost(profile, node)
    objects = [
        replace(
            each, values=tuple(_with_tag(v, by_object.get((v.index, v.subindex)), has, losses) for v in each.values)
        )
        for each in node.objects
    ]
    objects += _new_objects([tag for key, tag in by_object.items() if key not in known], objects, has, losses)
    return replace(node, objects=tuple(sorted(objects, key=lambda each: each.index))), losses


def read_profile_eds(profile: DeviceProfile) -> tuple[NodeDescription, tuple[str, ...]]:
    """Return the object dictionary of a CANopen profile, and the repairs that its file needed. Raises `FileInvalid`."""
    path = profile.eds_path
    if path is None:
        raise FileInvalid("a CANopen profile needs an EDS", path=profile.path, expected="`eds: FILE.eds`")
    with reading(path):
        data = read_input(path, MAX_EDS_BYTES)
    return read_eds(data, path)


def _with_tag(value: NodeValue, tag: Tag | None, has: Collection[str], losses: list[Loss]) -> NodeValue:
    """Return the value with the properties of its tag that the format has; note those that it does not have."""
    if tag is None:
        return value
    for what, stated in ((OFFSET, tag.offset != 0.0), (VALUE_NAMES, bool(tag.values))):
        if stated and what not in has:
            losses.append(Loss(f"tag {tag.name}", what, _NO_PLACE_FOR_IT))
    losses += tag_losses(tag, _NO_PLACE_FOR_IT)
    kind = TAG_TYPES.get(value.type_code)
    if kind != tag.type:
        losses.append(Loss(f"tag {tag.name}", f"its type {tag.type}", f"the EDS says {type_name(value.type_code)}"))
    may = "rw" if value.access in _WRITABLE else "wo" if value.access == "wo" else "ro"
    if may != tag.access:
        losses.append(Loss(f"tag {tag.name}", f"its access {tag.access}", f"the EDS says {value.access}"))
    low, high = _limits(tag, losses) if tag.range is not None and kind == tag.type else (value.low, value.high)
    factor = f"{tag.scale!r}" if tag.scale != 1.0 else value.factor
    offset = f"{tag.offset!r}" if tag.offset and OFFSET in has else value.offset
    names = tag.values if VALUE_NAMES in has and tag.values else value.names
    unit = tag.unit or value.unit
    return replace(value, low=low, high=high, unit=unit, factor=factor, offset=offset, names=names)


def tag_losses(tag: Tag, why: str) -> Iterator[Loss]:
    """Yield the properties that the tag states and a description of a CANopen device does not have. `why` is the reason."""
    stated = {
        "`scale_by`": tag.scale_by is not None,
        "`sentinels`": bool(tag.sentinels),
        "`counter`": tag.counter,
        "`nonvolatile`": tag.nonvolatile,
        "`secret`": tag.secret,
        "`danger`": bool(tag.danger),
    }
    for what, present in stated.items():
        if present:
            yield Loss(f"tag {tag.name}", what, why)


def poll_groups_lost(profile: DeviceProfile) -> Iterator[Loss]:
    """Yield a loss if the profile states poll groups."""
    if profile.groups != ["values"]:
        yield Loss("all tags", "the poll groups", NO_PLACE)


def _names_lost(profile: DeviceProfile, node: NodeDescription) -> Iterator[Loss]:
    """Yield the tags whose names or poll groups an import of the result would not find again."""
    names = object_names(node)
    for tag in profile.tags.values():
        if tag.object is not None and names.get(tag.object) != tag.name:
            yield Loss(f"tag {tag.name}", "its name", "the object keeps its name in the object dictionary")
    yield from poll_groups_lost(profile)


def object_names(node: NodeDescription) -> dict[tuple[int, int], str]:
    """Return the tag name of each value of the object dictionary, by index and subindex, as an import makes it."""
    listed = [(v.index, v.subindex, each.name, v.name) for each in node.objects for v in each.values]
    return {(i, s): name for (i, s, _, _), name in zip(listed, tag_names(listed), strict=True)}


def _limits(tag: Tag, losses: list[Loss]) -> tuple[str, str]:
    """Return LowLimit and HighLimit of a tag with a range, as raw values."""
    assert tag.range is not None
    raw = sorted((limit - tag.offset) / tag.scale for limit in tag.range)
    if tag.type not in INTEGER_RANGES:
        return repr(raw[0]), repr(raw[1])
    whole = [round(value) for value in raw]
    if any(abs(a - b) > 1e-6 for a, b in zip(raw, whole, strict=True)):
        losses.append(
            Loss(f"tag {tag.name}", "a part of its range", "the limits are raw values, which are whole numbers")
        )
    low, high = INTEGER_RANGES[tag.type]
    return str(max(low, whole[0])), str(min(high, whole[1]))


def _new_objects(
    tags: Iterable[Tag], known: Iterable[NodeObject], has: Collection[str], losses: list[Loss]
) -> Iterator[NodeObject]:
    """Yield objects for tags that are not in the EDS. A missing sub-object of an object that the EDS has is lost."""
    indexes = {each.index for each in known}
    for tag in tags:
        assert tag.object is not None
        index, subindex = tag.object
        if subindex or index in indexes or tag.type not in TYPE_CODES:
            losses.append(Loss(f"tag {tag.name}", "the tag", f"the EDS has no object {index:04X}h:{subindex:02X}"))
            continue
        value = NodeValue(index, 0, tag.name, TYPE_CODES[tag.type], tag.access)
        yield NodeObject(index, tag.name, VAR, (_with_tag(value, tag, has, losses),))
