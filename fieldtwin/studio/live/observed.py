"""The description of a system for pages and other programs: buses, devices with their tags, programs."""

from __future__ import annotations

from typing import Any

from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.twin.site.system import System


def describe_system(system: System) -> dict[str, Any]:
    """Return the parts of a system that do not change during a run, as data for JSON."""
    return {
        "name": system.name,
        "path": str(system.path),
        "buses": {
            name: {"endpoint": str(bus.endpoint), "kind": _kind(bus.endpoint.is_can, bus.endpoint.is_serial)}
            for name, bus in system.buses.items()
        },
        "devices": {
            name: {
                "bus": device.bus,
                "address": device.address,
                "device": device.profile.form.device,
                "protocol": device.profile.protocol,
                "tags": {tag.name: _tag(tag, tag.name in device.writable) for tag in device.profile.tags.values()},
            }
            for name, device in system.devices.items()
        },
        "programs": {
            name: {
                "source": form.source,
                "inputs": {v: i.tag for v, i in form.inputs.items()},
                "outputs": dict(form.outputs),
            }
            for name, form in system.plc.programs.items()
        },
        "alarms": list(system.alarms),
        "cycle_ms": system.plc.cycle_ms,
    }


def _kind(is_can: bool, is_serial: bool) -> str:
    return "CAN bus" if is_can else "serial line" if is_serial else "network"


def _tag(tag: Tag, writable: bool) -> dict[str, Any]:
    return {
        "unit": tag.unit,
        "type": tag.type,
        "at": place(tag),
        "values": {str(number): name for number, name in tag.values},
        "range": list(tag.range) if tag.range else None,
        "readable": tag.readable,
        "writable": writable,
        "secret": tag.secret,
        "impact": tag.danger,
    }


def place(tag: Tag) -> str:
    """Return where a tag is in its device: an object of CANopen, or registers."""
    if tag.object is not None:
        return f"{tag.object[0]:04X}h:{tag.object[1]:02X}"
    return str(tag.at) if tag.at is not None else ""
