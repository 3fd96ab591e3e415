"""Warnings for the author of a system file about tags that the gateway reads only once, after it has connected.

The present value in the device is then unknown: the published value is the one read at the start, or there is none. The
published value stays good even if the device changes the value or is lost. If the device loses a written value, the gateway
does not notice it and does not write it again; every start of the gateway writes it again. This module only inspects a loaded
system file.
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
        writable = file.section("devices")[name].get("writable", [])
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


ONCE = ("identity", "setup")
"""Poll groups whose values do not change while the device runs. The gateway reads them only once, by design."""


def read_only_once(file: YamlFile, devices: Mapping[str, DeviceConfig]) -> tuple[str, ...]:
    """Return a warning for each poll group of measured values that is read once, because the device's `poll` lacks it.

    A tag of `writable` has its own warning (`never_read_back`), a transmitter's mailbox is read without an entry, and every
    value of a CANopen node becomes stale, so that it does not stay good.
    """
    found = []
    for name, device in devices.items():
        if device.profile.inbox is not None or device.profile.protocol != "modbus":
            continue
        writable = file.section("devices")[name].get("writable", [])
        groups: dict[str, list[Tag]] = {}
        for tag in device.profile.tags.values():
            if tag.readable and tag.poll not in ONCE and tag.name not in writable and not _read_again(device, tag):
                groups.setdefault(tag.poll, []).append(tag)
        for group, tags in groups.items():
            more = f" and {len(tags) - 1} more" if tags[1:] else ""
            error = file.error(
                ("devices", name),
                f"{name}.{tags[0].name}{more} {'are' if tags[1:] else 'is'} read only once, after connecting: the "
                f"poll group {group!r} has no period",
                expected=_remedy(device, tags[0]),
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
