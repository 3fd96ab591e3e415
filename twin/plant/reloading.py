"""Compares two versions of a system's files: what changed, and which changes a running gateway can apply.

Timing, periods, limits, scaling and safe values can change between two polls, and so can the plant's switch and the
limits of commands over a thread. Ports, addresses, the kind of a device, programs and their bindings cannot. If one
change needs a restart, it is named and nothing is applied. Keys that are not listed here as changeable need a restart.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile, load, validate
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.twin.plant.physical import plant_tags
from fieldtwin.twin.site.schema import SystemForm
from fieldtwin.twin.site.system import System

Loc = tuple[Key, ...]
GATE = frozenset({"remote", "commands"})
"""Keys of the command gate. They can change at run time, so that an operator never has to stop a plant to operate the
switch.
"""
BUS = frozenset({"timeout_ms", "retries", "spacing_ms", "turnaround_ms", "connect_pause_ms", "probe_percent"})
"""Keys of a Modbus bus. A CAN bus has no key that could change."""
DEVICE = frozenset({"poll", "stale_after_ms", "safe", "backoff_first_ms", "backoff_limit_ms"})
MODBUS_DEVICE = DEVICE | {"timeout_ms", "retries", "spacing_ms", "writable"}
PROFILE = frozenset({"source", "limits", "gaps", "timing"})
TAG = frozenset({"scale", "offset", "sentinels", "values", "range", "secret", "danger", "description"})
SCALING = frozenset({"scale", "offset"})
NOTHING = object()


@dataclass(frozen=True, slots=True)
class ConfigChange:
    """One changed value: its file and place, its keys, the old and new text, and whether it can be applied at run time."""

    where: str
    what: str
    old: str
    new: str
    live: bool

    def __str__(self) -> str:
        return f"{self.what}: {self.old} -> {self.new}" if self.old or self.new else self.what


def compare(old: System, new: System) -> list[ConfigChange]:
    """Return the changes in `new`: first the system file, in the order of its keys, then profiles, then the files that
    they name.
    """
    before, after = _dump(old), _dump(new)
    found = [
        _change(new.file, at, a, b, live=_is_live(new, at, before, after), secret=_is_secret(new, at))
        for at, a, b in _differences(before, after)
    ]
    found += _of_profiles(old, new)
    if all(c.live for c in found):
        found += _unexplained(old, new)
    return found


def limits_changed(old: System, new: System) -> dict[str, tuple[float, float] | None]:
    """Return the new limits of each tag whose limits changed, None if it has no limits any more. The PLC has a copy of the
    limits, to check forces.
    """
    before, after = plant_tags(old), plant_tags(new)
    return {name: spec.limits for name, spec in after.items() if name in before and spec.limits != before[name].limits}


def _dump(system: System) -> dict[str, Any]:
    return validate(system.file, SystemForm).model_dump(by_alias=True)


def _differences(old: Any, new: Any, at: Loc = ()) -> Iterator[tuple[Loc, Any, Any]]:
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in [*new, *(k for k in old if k not in new)]:
            yield from _differences(old.get(key, NOTHING), new.get(key, NOTHING), (*at, key))
    elif old != new:
        yield at, old, new


def _is_live(new: System, at: Loc, before: Mapping[str, Any], after: Mapping[str, Any]) -> bool:
    if at[0] in GATE:
        return True
    if len(at) < 3:
        return False
    section, name, key = at[:3]
    if section == "buses":
        bus = new.buses.get(str(name))
        return bus is not None and not bus.endpoint.is_can and key in BUS
    if section != "devices" or name not in new.devices:
        return False
    if new.devices[str(name)].profile.protocol == "modbus":
        return key in MODBUS_DEVICE
    polled = [bool(form["devices"][name]["poll"]) for form in (before, after)]
    return key in DEVICE and (key != "poll" or all(polled))


def _is_secret(system: System, at: Loc) -> bool:
    if len(at) < 4 or at[0] != "devices" or at[1] not in system.devices:
        return False
    tag = system.devices[str(at[1])].profile.tags.get(str(at[3]))
    return tag is not None and tag.secret


def _of_profiles(old: System, new: System) -> list[ConfigChange]:
    found: dict[tuple[str, str], ConfigChange] = {}
    for name, device in new.devices.items():
        if name not in old.devices:
            continue
        profile, before = device.profile, old.devices[name].profile
        if profile.path == before.path and profile.hash == before.hash:
            continue
        file = load(Path(profile.path))
        for at, a, b in _differences(before.form.model_dump(by_alias=True), profile.form.model_dump(by_alias=True)):
            change = _change(file, at, a, b, live=_is_live_in_profile(before, profile, at))
            found.setdefault((change.where, change.what), replace(change, what=f"{profile.name}: {change.what}"))
    return list(found.values())


def _is_live_in_profile(before: DeviceProfile, after: DeviceProfile, at: Loc) -> bool:
    if at[0] != "tags":
        return at[0] in PROFILE or at == ("sampled", "slack_ms")
    if len(at) < 3 or at[2] not in TAG:
        return False
    # the process image stores the tag either as an integer or as a real number, which cannot change in a run
    tag = str(at[1])
    return at[2] not in SCALING or before.tags[tag].is_integer == after.tags[tag].is_integer


def _unexplained(old: System, new: System) -> list[ConfigChange]:
    """Return the differences that no changeable key explains, for example in a DCF or an EDS that the files name, or in a
    profile's messages.
    """
    found = []
    for name, device in new.devices.items():
        before = old.devices[name]
        if _fixed(device) != _fixed(before) or device.canopen != before.canopen:
            found.append(_change(new.file, ("devices", name), "", "", live=False))
    located = list(_located(old, new))
    found += located
    if (new.serving != old.serving and not located) or new.plc != old.plc:
        found.append(_change(new.file, ("serve",), "", "", live=False))
    # A tag that became secret needs a restart: the process that serves metrics keeps the old list.
    if new.exported_tags != old.exported_tags:
        found.append(_change(new.file, ("metrics",), "", "", live=False))
    return found


def _located(old: System, new: System) -> Iterator[ConfigChange]:
    """Yield a change for each server whose located variables are different in the sources of the programs."""
    before = {server.name: server for server in old.serving.serve}
    for server in new.serving.serve:
        if server.name not in before or server == before[server.name]:
            continue
        names = sorted({tag.tag for tag in {*server.tags} ^ {*before[server.name].tags}})
        if names:
            change = _change(new.file, ("serve", server.name), "", "", live=False)
            yield replace(
                change, what=f"serve.{server.name}: the registers of {', '.join(names)} change with the source"
            )


def _fixed(device: DeviceConfig) -> tuple[object, ...]:
    p = device.profile
    return (
        device.bus, device.address, device.expect, device.heartbeat, device.tpdo1, device.start,
        p.messages, p.inbox, p.outbox, p.command_list, p.eds_path,
        {n: (t.at, t.object, t.type, t.poll, t.access, t.unit, t.is_integer) for n, t in p.tags.items()},
    )  # fmt: skip


def _change(file: YamlFile, at: Loc, old: Any, new: Any, *, live: bool, secret: bool = False) -> ConfigChange:
    spot: FileInvalid = file.error(at, "")
    texts = ("(secret)", "(secret)") if secret else (_text(old), _text(new))
    return ConfigChange(f"{spot.path}:{spot.line}:{spot.column}", ".".join(map(str, at)), *texts, live)


def _text(value: Any) -> str:
    if value is NOTHING:
        return "nothing"
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
