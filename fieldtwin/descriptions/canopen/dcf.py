"""The format DCF: the configuration of one CANopen node (CiA 306-1, 4.7)."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from fieldtwin.descriptions.canopen.eds import modified_ns
from fieldtwin.descriptions.canopen.eds_reader import read_eds
from fieldtwin.descriptions.canopen.eds_writer import write_eds
from fieldtwin.descriptions.canopen.node import NodeDescription, NodeValue
from fieldtwin.descriptions.canopen.node_of_profile import node_of_profile
from fieldtwin.descriptions.canopen.profile_of_node import profile_of_node
from fieldtwin.descriptions.conversion import Exported, Imported, Settings, Source, whole_setting
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.protocols.canopen.eds.values import read_value

TITLE = "DCF"
_OBJECT = re.compile(r"([0-9A-Fa-f]{4}):([0-9A-Fa-f]{2})")


def import_description(source: Source, settings: Settings) -> Imported:
    """Return a profile whose object dictionary is the DCF, unchanged. Raises `FileInvalid` and `UsageError`.

    The profile's `factory` has the node ID of the DCF. A prototype starts with the DCF's values, and a system file can name the
    same file as `dcf`, so that the gateway configures the node.
    """
    node, repairs = read_eds(source.data, source.path)
    profile, losses = profile_of_node(node, source.path.name, TITLE, source, settings)
    return Imported(profile, losses, {source.path.name: source.data}, repairs)


def export_description(profile: DeviceProfile, settings: Settings) -> Exported:
    """Return the DCF of a profile: its EDS, a node ID, and the values that the profile's DCF or `settings` set.

    Raises `FileInvalid` and `UsageError`.
    """
    node, losses = node_of_profile(profile, TITLE)
    node = configured_node(node, profile, settings)
    text = write_eds(node, f"{Path(profile.path).stem}.dcf", modified_ns(profile), dcf=True)
    return Exported(text, tuple(losses))


def configured_node(node: NodeDescription, profile: DeviceProfile, settings: Settings) -> NodeDescription:
    """Return the node with the node ID, the bit rate and the values of objects in `settings`. Raises `UsageError`."""
    node_id = whole_setting(settings, "node", 1, 127) or node.node_id or profile.form.factory.node
    bitrate = whole_setting(settings, "bitrate", 10, 1000) or node.bitrate_kbit
    wanted = {_key(key): (key, text) for key, text in settings.items() if ":" in key}
    for where in set(wanted) - {(v.index, v.subindex) for v in node.values()}:
        raise UsageError(f"no object {wanted[where][0]} in this profile's EDS", hint="index and subindex, as 1017:00")
    objects = tuple(
        replace(each, values=tuple(_configured(v, wanted.get((v.index, v.subindex)), node_id) for v in each.values))
        for each in node.objects
    )
    return replace(node, objects=objects, node_id=node_id, bitrate_kbit=bitrate)


def _key(text: str) -> tuple[int, int]:
    found = _OBJECT.fullmatch(text)
    if found is None:
        raise UsageError(f"cannot read the object {text!r}", expected="index and subindex in hex, such as 1017:00")
    return int(found[1], 16), int(found[2], 16)


def _configured(value: NodeValue, setting: tuple[str, str] | None, node_id: int) -> NodeValue:
    if setting is None:
        return value
    key, text = setting
    try:
        read_value(value.type_code, text, node_id)
    except (ValueError, OverflowError) as e:
        raise UsageError(f"cannot use --set {key}={text}", expected=f"a value for {value.name}", got=str(e)) from e
    if value.access in ("ro", "const"):
        raise UsageError(f"{key} ({value.name}) cannot be written", expected="an object that a master may write")
    return replace(value, configured=text)
