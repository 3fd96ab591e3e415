"""Decide which tags of a profile a format can hold, and list what it loses.

A tag whose value the other program would show wrongly is left out: a wrong number is worse than none. The only exception is a
value with a scale-factor register (SunSpec): its raw number is exported under a name that ends with ``_raw``.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

from fieldtwin.descriptions.conversion import Loss, require_protocol
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.profile import BIT_TABLES, DeviceProfile, Tag
from fieldtwin.gateway.core.files.profile_schema import ProfileForm

PLACEHOLDER = "tcp://192.0.2.1:502"
"""The endpoint in an export without a stated endpoint: an address for documentation (RFC 5737), which no device has."""

_OPTIONAL = {
    "unit": "unit of measurement",
    "values": "names of values",
    "range": "permitted range",
    "counter": "mark as a counter",
    "nonvolatile": "mark as stored without power",
    "danger": "danger of a write",
    "sentinels": "values that mean that there is no value",
    "description": "description",
}
"""The properties of a tag that a format may lack without showing a wrong value, and their names in messages."""

_OF_DEVICE = {
    "limits": "functions, limits of a request and gaps to read across",
    "timing": "pauses and times",
    "gaps": "registers that must not be read",
    "undeclared": "answer for registers without a tag",
    "identify": "registers that identify the device",
    "sampled": "group of samples",
    "trigger": "measurement on request",
    "mailbox": "mailboxes",
    "messages": "messages",
    "functions": "functions of the device",
    "effects": "effects of reading and writing",
    "server_id": "server ID",
    "server_data": "data of the server ID",
    "identification": "device identification",
    "files": "files",
    "fifos": "FIFO queues",
    "commands": "names of commands",
    "behaviours": "behaviours",
}


@dataclass(frozen=True)
class Abilities:
    """The properties of tags that a format can hold. `name` is the name of its program, for messages.

    `keeps` lists properties of `_OPTIONAL`, ``poll`` and ``access`` and, if the format has them, the calculations ``offset`` and
    ``bits``. `types` are the types of registers.

    `write_only` states whether it can hold a value that is only written, `single_bits` whether it can read one bit of a register.
    """

    name: str
    keeps: Collection[str]
    types: Collection[str]
    write_only: bool = False
    single_bits: bool = False


def exported(profile: DeviceProfile, abilities: Abilities, losses: list[Loss]) -> Iterator[Tag]:
    """Yield the tags that the format can hold, and add what it loses to `losses`."""
    require_protocol(profile, "modbus", abilities.name)
    losses += device_losses(profile.form, abilities)
    described = descriptions(profile)
    for stated in profile.tags.values():
        tag, place = stated, f"tag {stated.name}"
        if tag.type == "bool" and tag.registers.table not in BIT_TABLES:
            tag = replace(tag, type="uint16", scale=1.0, offset=0.0)  # a bool has no scale
        why = _reason_to_omit(tag, abilities)
        if why:
            losses.append(Loss(place, "the tag", why))
            continue
        if tag.type != stated.type:
            losses.append(Loss(place, "type bool", "it is in a register, and is exported as a number"))
        losses += [
            Loss(place, what, f"{abilities.name} has no place for it")
            for key, what in _OPTIONAL.items()
            if key not in abilities.keeps
            and (key in described.get(tag.name, {}) if key == "description" else _has(tag, key))
        ]
        if tag.writable and "access" not in abilities.keeps:
            losses.append(Loss(place, "write access", f"{abilities.name} only reads this value"))
        if tag.poll != "values" and "poll" not in abilities.keeps:
            losses.append(Loss(place, "poll group", f"{abilities.name} has no groups"))
        if tag.scale_by is None:
            yield tag
            continue
        raw = f"{tag.name}_raw"
        losses.append(
            Loss(place, "scale factor", f"exported as {raw}: multiply it by ten to the power of {tag.scale_by}")
        )
        yield replace(tag, name=raw, scale_by=None)


def _has(tag: Tag, key: str) -> bool:
    return bool(getattr(tag, key)) if key != "range" else tag.range is not None


def _reason_to_omit(tag: Tag, abilities: Abilities) -> str:
    """Return why the format cannot hold a tag, or an empty text."""
    name = abilities.name
    if tag.secret:
        return f"it is secret, and {name} would show its value"
    if not tag.readable and not abilities.write_only:
        return f"it can only be written, and {name} would read it"
    if tag.bits is not None and not ("bits" in abilities.keeps or (abilities.single_bits and tag.is_bit)):
        return f"{name} cannot extract bits {tag.bits[0]} to {tag.bits[1]} of a register"
    if tag.type != "bool" and tag.type not in abilities.types:
        return f"{name} has no type {tag.type}"
    if tag.offset and "offset" not in abilities.keeps:
        return f"{name} cannot add the offset {tag.offset:g}"
    return ""


def descriptions(profile: DeviceProfile) -> dict[str, dict[str, str]]:
    """Return the description of each tag that has one, by the name of the tag."""
    found: dict[str, dict[str, str]] = {}
    for name, form in profile.form.tags.items():
        match = re.fullmatch(r"(.*?)([0-9]+)\.\.([0-9]+)", name)
        names = [f"{match[1]}{n}" for n in range(int(match[2]), int(match[3]) + 1)] if match else [name]
        if form.description:
            found |= {each: {"description": form.description} for each in names}
    return found


def device_losses(form: ProfileForm, abilities: Abilities) -> Iterator[Loss]:
    """Yield a loss for each property of the device that differs from its default and is not in `keeps`."""
    fields = ProfileForm.model_fields
    for key, what in _OF_DEVICE.items():
        if getattr(form, key) != fields[key].get_default(call_default_factory=True) and key not in abilities.keeps:
            yield Loss(f"key {key}", what, f"{abilities.name} has no place for it")


def stated_endpoint(profile: DeviceProfile, endpoint: str, losses: list[Loss]) -> tuple[Endpoint, SerialSettings]:
    """Return the endpoint to write into a configuration, and the settings of the serial line.

    Without `endpoint` it is `PLACEHOLDER`, and a loss states this. Raises `UsageError` for an endpoint that cannot be read or
    cannot be exported.
    """
    if not endpoint:
        losses.append(
            Loss(
                "connection", "address of the device", f"a profile has none; {PLACEHOLDER} is a placeholder to replace"
            )
        )
    found = Endpoint.parse(endpoint or PLACEHOLDER)
    if found.is_can or found.scheme in ("pty", "tls"):
        raise UsageError(f"{endpoint} cannot be exported", expected="tcp:, udp:, rtu+tcp:, rtu: or ascii:")
    factory = profile.form.factory
    usual = SerialSettings(factory.baudrate, factory.frame)
    stated = dict(found.params)
    return found, SerialSettings(int(stated.get("baudrate", usual.baudrate)), stated.get("frame", usual.frame).upper())


def shorten(number: float) -> int | float:
    """Return a whole number without a decimal point."""
    return int(number) if float(number).is_integer() and abs(number) < 2**53 else number
