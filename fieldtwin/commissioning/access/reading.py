"""Find and open the device that a command line names, and turn its values into rows for a table or JSON.

This module must never write.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fieldtwin.commissioning.access.connection import canopen_at, modbus_at
from fieldtwin.commissioning.access.point import CanopenPoint, ModbusPoint, Point, PointValue
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.connection import Connector, Tap
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable, UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile, Tag
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.gateway.protocols.canopen.eds.dictionary import ObjectDictionary, load_dictionary
from fieldtwin.twin.site.data_files import find

MOST_HEX_BYTES = 48


@dataclass(frozen=True, slots=True)
class DeviceTarget:
    """A device: its endpoint, its unit ID or node ID, and its profile or EDS."""

    url: str
    address: int
    profile: DeviceProfile | None = None
    dictionary: ObjectDictionary | None = None
    bitrate: int = 0
    timeout_s: float = 1.0
    echo: bool = False

    @property
    def protocol(self) -> str:
        return "canopen" if Endpoint.parse(self.url).is_can else "modbus"


def target_of(
    url: str,
    *,
    address: int | None = None,
    profile_name: str = "",
    eds: Path | None = None,
    folders: Iterable[Path] = (),
    bitrate: int = 0,
    timeout_s: float = 1.0,
    echo: bool = False,
) -> DeviceTarget:
    """Return the device that a command line names. Without `address` it is the profile's factory setting, else 1.

    If the URL of a serial line states no baud rate or frame, the profile's settings are used. Raises `UsageError` if endpoint and
    profile do not belong together, `FileInvalid` for an invalid profile or EDS.
    """
    endpoint = Endpoint.parse(url)
    profile = load_profile(find("devices", profile_name, extra=folders)) if profile_name else None
    protocol = "canopen" if endpoint.is_can else "modbus"
    if profile is not None and profile.protocol != protocol:
        raise UsageError(
            f"{profile.name} is a {profile.protocol} device", expected=f"an endpoint of {profile.protocol}"
        )
    if eds is not None and protocol != "canopen":
        raise UsageError("an EDS is for a CANopen device", got=url)
    if address is None and profile is not None:
        address = profile.form.factory.node if protocol == "canopen" else profile.form.factory.unit
    if profile is not None and endpoint.is_serial and not endpoint.params:
        factory = profile.form.factory
        url = str(replace(endpoint, params=(("baudrate", str(factory.baudrate)), ("frame", factory.frame))))
    address = 1 if address is None else address
    eds = eds or (profile.eds_path if profile is not None else None)
    dictionary = load_dictionary(eds, address) if eds is not None else None
    return DeviceTarget(url, address, profile, dictionary, bitrate, timeout_s, echo)


@asynccontextmanager
async def point_at(
    target: DeviceTarget,
    *,
    taps: Sequence[Tap] = (),
    spacing_s: float = 0.0,
    connector: Connector | None = None,
    clock: Clock | None = None,
) -> AsyncIterator[Point]:
    """Yield the device, ready for queries; opening sends nothing. Raises the same errors as `modbus_at` and `canopen_at`.

    The profile's timing is respected: its pause between exchanges, and its response time if that is longer.
    """
    timeout_s = target.timeout_s
    if target.profile is not None:
        timing = target.profile.form.timing
        spacing_s = max(spacing_s, timing.spacing_ms / 1000)
        timeout_s = max(timeout_s, (timing.timeout_ms or 0) / 1000)
    if target.protocol == "canopen":
        async with canopen_at(
            target.url, target.bitrate, sdo_timeout_s=timeout_s, taps=taps, connector=connector, clock=clock
        ) as master:
            yield CanopenPoint(master, target.url, target.address)
        return
    async with modbus_at(
        target.url,
        timeout_s=timeout_s,
        spacing_s=spacing_s,
        echo=target.echo,
        taps=taps,
        connector=connector,
        clock=clock,
    ) as client:
        yield ModbusPoint(client, target.url, target.address, target.profile)


async def read_all(
    target: DeviceTarget,
    tags: Sequence[Tag],
    *,
    taps: Sequence[Tap] = (),
) -> dict[str, PointValue]:
    """Read each of `tags` once, and return a value or a problem for each of them by name.

    A tag that cannot be read (`access: wo`) is not requested. A tag of a request that failed is read alone. If the connection is
    lost, that error becomes the problem of the tags that were not read before; if none was read, the error is raised:
    `Unreachable` or `ConnectionLost`.
    """
    found: dict[str, PointValue] = {}
    lost: Unreachable | None = None
    try:
        async with point_at(target, taps=taps) as point:
            await point.read([t for t in tags if t.readable], found, alone=True)
    except Unreachable as e:
        if not found:
            raise
        lost = e
    return {t.name: found.get(t.name) or _not_read(t, lost) for t in tags}


def _not_read(tag: Tag, lost: Unreachable | None) -> PointValue:
    if not tag.readable:
        return PointValue(TagValue(None, Quality.BAD, Reason.REFUSED), "not asked: it can only be written (access: wo)")
    problem = lost.message if lost is not None else "not asked"
    return PointValue(TagValue(None, Quality.BAD, Reason.UNREACHABLE), problem)


def dry_point(target: DeviceTarget) -> Point:
    """Return the device for `--dry-run`: it returns the frames of requests and cannot send them."""
    if target.protocol == "canopen":
        return CanopenPoint(None, target.url, target.address)
    return ModbusPoint(None, target.url, target.address, target.profile)


def text_of(tag: Tag, answer: PointValue) -> str:
    """Return a value for display, with the profile's name for the number if it has one; secrets are hidden."""
    value = answer.value.value
    if value is None:
        return "-"
    if tag.secret:
        return "(secret)"
    if isinstance(value, bytes):
        dots = " ..." if len(value) > MOST_HEX_BYTES else ""
        return value[:MOST_HEX_BYTES].hex(" ") + dots
    if isinstance(value, str):
        return repr(value)
    named = dict(tag.values).get(int(value)) if value == int(value) else None
    text = f"{value:.7g}" if isinstance(value, float) else str(int(value))
    return f"{text} ({named})" if named is not None else text


def place_of(tag: Tag) -> str:
    """Return the address of a tag, in both notations for registers."""
    if tag.at is not None:
        return str(tag.at)
    assert tag.object is not None
    return f"{tag.object[0]:04X}h:{tag.object[1]:02X}"


def row_of(tag: Tag, answer: PointValue) -> dict[str, Any]:
    """Return a value as a dictionary for JSON. `raw` are the bytes that the device sent, in hex (one byte for each bit)."""
    value = answer.value
    shown = value.value.hex() if isinstance(value.value, bytes) else value.value
    row = {
        "name": tag.name,
        "at": place_of(tag),
        "type": tag.type,
        "value": None if tag.secret else shown,
        "unit": tag.unit,
        "quality": str(value.quality),
        "raw": "" if tag.secret else value.raw.hex(),
    }
    if isinstance(value.value, int) and not tag.secret and value.value in dict(tag.values):
        row["meaning"] = dict(tag.values)[value.value]
    if value.quality is not Quality.GOOD:
        row["reason"] = str(value.reason)
    return row | ({"problem": answer.problem} if answer.problem else {})
