"""Warnings for the author of a system file about tags that the gateway may write and never reads back.

The value that the device holds in such a tag is unknown: the published value is the one read at the start, or there is
none. A device that loses the written value does not get it again, and every start writes it again. Pure: it inspects a
loaded system file.
"""

from __future__ import annotations

from collections.abc import Mapping

from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.core.files.yaml_file import YamlFile
from fieldtwin.gateway.devices.config import DeviceConfig


def never_read_back(file: YamlFile, devices: Mapping[str, DeviceConfig]) -> tuple[str, ...]:
    """Return a warning for each entry of `writable` that is readable but read neither by a poll nor by process data of
    its node.

    A node whose process data is known only once it is connected (``tpdos: node``) gives no warning.
    """
    found = []
    for name, device in devices.items():
        writable = file.data["devices"][name].get("writable", [])
        for at, local in enumerate(writable):
            tag = device.profile.tags.get(local)
            if tag is not None and tag.readable and not _read_again(device, tag):
                error = file.error(
                    ("devices", name, "writable", at),
                    f"{name}.{local} may be written but is never read back, so the device's value is unknown",
                    expected=_remedy(device, tag),
                )
                found.append(str(error))
    return tuple(found)


def _read_again(device: DeviceConfig, tag: Tag) -> bool:
    if tag.poll in device.poll or (device.tpdo1 is not None and tag.name in device.tpdo1.tags):
        return True
    if device.canopen.adopt_tpdos:
        return True
    mapped = {
        (e.index, e.subindex) for tpdo in device.canopen.tpdos or () if tpdo.enabled for e in tpdo.mapping.entries
    }
    return tag.object is not None and tag.object in mapped


def _remedy(device: DeviceConfig, tag: Tag) -> str:
    poll = f"`{tag.poll}: {{every_ms: 1000}}` in `poll` of {device.name}"
    return f"{poll}, or the tag in its `tpdo1`" if device.profile.protocol == "canopen" else poll
