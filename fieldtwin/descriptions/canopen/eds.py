"""The format EDS: electronic data sheets of CANopen devices (CiA 306-1)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from fieldtwin.descriptions.canopen.eds_reader import read_eds
from fieldtwin.descriptions.canopen.eds_writer import write_eds
from fieldtwin.descriptions.canopen.node import NodeDescription
from fieldtwin.descriptions.canopen.node_of_profile import node_of_profile
from fieldtwin.descriptions.canopen.profile_of_node import profile_of_node
from fieldtwin.descriptions.conversion import Exported, Imported, Loss, Settings, Source
from fieldtwin.gateway.core.files.profile import DeviceProfile

TITLE = "EDS"


def import_description(source: Source, settings: Settings) -> Imported:
    """Return a profile whose object dictionary is the file itself, unchanged. Raises `FileInvalid` and `UsageError`."""
    node, repairs = read_eds(source.data, source.path)
    profile, losses = profile_of_node(node, source.path.name, TITLE, source, settings)
    return Imported(profile, losses, {source.path.name: source.data}, repairs)


def export_description(profile: DeviceProfile, settings: Settings) -> Exported:
    """Return the EDS of a profile. Raises `FileInvalid` and `UsageError`."""
    node, losses = node_of_profile(profile, TITLE)
    text = write_eds(node, f"{Path(profile.path).stem}.eds", modified_ns(profile))
    return Exported(text, (*losses, *values_lost(node)))


def values_lost(node: NodeDescription) -> Iterator[Loss]:
    """Yield a loss if the description sets values, for a format without them."""
    if any(v.configured for v in node.values()):
        yield Loss(
            "the object dictionary", "the values that are set", "the format describes a type of device, not one node"
        )


def modified_ns(profile: DeviceProfile) -> int:
    """Return the time at which the file of the profile was changed, in ns since 1970: the date of a description."""
    return Path(profile.path).stat().st_mtime_ns
