"""The format XDC: the configuration of one CANopen node in XML (CiA 311)."""

from __future__ import annotations

from pathlib import Path

from fieldtwin.descriptions.canopen import xdd
from fieldtwin.descriptions.canopen.dcf import configured_node
from fieldtwin.descriptions.canopen.eds import modified_ns
from fieldtwin.descriptions.canopen.node_of_profile import node_of_profile
from fieldtwin.descriptions.canopen.xdd_writer import write_xdd
from fieldtwin.descriptions.conversion import Exported, Imported, Settings, Source
from fieldtwin.gateway.core.files.profile import DeviceProfile

TITLE = "XDC"


def import_description(source: Source, settings: Settings) -> Imported:
    """Return a profile with a DCF that is made from the XDC. Raises `FileInvalid` and `UsageError`."""
    return xdd.imported(source, settings, TITLE, dcf=True)


def export_description(profile: DeviceProfile, settings: Settings) -> Exported:
    """Return the XDC of a profile, as `dcf.export_description` does for a DCF. Raises `FileInvalid` and `UsageError`."""
    node, losses = node_of_profile(profile, TITLE, xdd.HAS)
    node = configured_node(node, profile, settings)
    text = write_xdd(node, f"{Path(profile.path).stem}.xdc", modified_ns(profile), xdc=True)
    return Exported(text, tuple(losses))
