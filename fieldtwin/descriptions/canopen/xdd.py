"""The format XDD: descriptions of CANopen devices in XML (CiA 311)."""

from __future__ import annotations

from pathlib import Path

from fieldtwin.descriptions.canopen.eds import modified_ns, values_lost
from fieldtwin.descriptions.canopen.eds_writer import write_eds
from fieldtwin.descriptions.canopen.node_of_profile import OFFSET, VALUE_NAMES, node_of_profile
from fieldtwin.descriptions.canopen.profile_of_node import profile_of_node
from fieldtwin.descriptions.canopen.xdd_reader import read_xdd
from fieldtwin.descriptions.canopen.xdd_writer import write_xdd
from fieldtwin.descriptions.conversion import Exported, Imported, Settings, Source
from fieldtwin.gateway.core.files.profile import DeviceProfile

TITLE = "XDD"
HAS = (OFFSET, VALUE_NAMES)
"""Properties of tags that CiA 311 has a place for."""


def import_description(source: Source, settings: Settings) -> Imported:
    """Return a profile with an EDS that is made from the XDD. Raises `FileInvalid` and `UsageError`."""
    return imported(source, settings, TITLE, dcf=False)


def imported(source: Source, settings: Settings, title: str, *, dcf: bool) -> Imported:
    """Return the profile of an XDD or XDC. With `dcf` its object dictionary is a DCF with the values that the file sets."""
    node, repairs, parts = read_xdd(source.data, source.path)
    name = f"{source.path.stem}.{'dcf' if dcf else 'eds'}"
    profile, losses = profile_of_node(node, name, title, source, settings)
    lost = () if dcf else tuple(values_lost(node))
    return Imported(
        profile, (*losses, *parts, *lost), {name: write_eds(node, name, source.modified_ns, dcf=dcf)}, repairs
    )


def export_description(profile: DeviceProfile, settings: Settings) -> Exported:
    """Return the XDD of a profile. Raises `FileInvalid` and `UsageError`."""
    node, losses = node_of_profile(profile, TITLE, HAS)
    text = write_xdd(node, f"{Path(profile.path).stem}.xdd", modified_ns(profile))
    return Exported(text, (*losses, *values_lost(node)))
