"""Find the devices at an endpoint for a new site: scan, identify, and for an unknown Modbus unit a draft of its profile.

It only reads. This module must not depend on a display.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from fieldtwin.commissioning.access.progress import PhaseProgress
from fieldtwin.commissioning.access.reading import DeviceTarget
from fieldtwin.commissioning.dump.dump import DumpJob
from fieldtwin.commissioning.dump.file import load_dump
from fieldtwin.commissioning.dump.session import dump, register_spans
from fieldtwin.commissioning.identify.canopen import identify_canopen
from fieldtwin.commissioning.identify.matching import Candidate, Sureness
from fieldtwin.commissioning.identify.modbus import identify_modbus
from fieldtwin.commissioning.infer.draft import draft_profile
from fieldtwin.commissioning.infer.infer import infer, series_of
from fieldtwin.commissioning.scan.canopen import ALL_NODES, CanScanner, CanScanOptions
from fieldtwin.commissioning.scan.modbus import FoundUnit, ModbusScanner, ScanOptions
from fieldtwin.commissioning.scan.settings import with_settings
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, Unreachable, WireError
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.new_site.devices import is_shipped
from fieldtwin.new_site.wishes import DeviceWish

DRAFT_RANGES = ("input:0..499", "holding:0..499", "discrete:0..63", "coil:0..63")
"""The addresses that are read for a draft; to read all addresses of a device can take an hour."""
DRAFT_PASSES, DRAFT_EVERY_S, DRAFT_BUDGET_S = 6, 1.0, 15.0
IDENTIFY_TIMEOUT_S = 1.0


@dataclass(slots=True)
class Scanned:
    """The devices that were found, and remarks for the user about each of them. `stopped`: the user ended the scan."""

    devices: list[DeviceWish] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    stopped: bool = False


async def scan_endpoint(
    url: str,
    addresses: tuple[int, ...] | None,
    known: Iterable[DeviceProfile],
    *,
    words: str,
    on_progress: Callable[[PhaseProgress], None] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
) -> Scanned:
    """Scan `url`, identify each device, and draft a profile for a Modbus unit that no profile fits.

    `addresses` are the unit IDs or node IDs to ask; None: all. `words` is the command line, for the log of a dump. Raises
    `Unreachable` if the endpoint cannot be opened.
    """
    profiles = list(known)
    names = {profile.name: _reference(profile) for profile in profiles}
    found = Scanned()
    if Endpoint.parse(url).is_can:
        options = CanScanOptions(nodes=addresses or ALL_NODES, lss=False)
        nodes = await CanScanner(url, options, on_progress=on_progress, stop=stop).run()
        found.stopped = nodes.stopped
        for node in nodes.nodes:
            identity = await identify_canopen(url, node.node, profiles)
            _take(found, f"node {node.node}", url, node.node, _best(identity.candidates), names)
        return found
    units = await ModbusScanner(url, ScanOptions(units=addresses), on_progress=on_progress, stop=stop).run()
    found.stopped = units.stopped
    for unit in units.units:
        await _add_unit(found, url, unit, profiles, names, words)
    return found


async def _add_unit(
    found: Scanned, url: str, unit: FoundUnit, profiles: list[DeviceProfile], names: dict[str, str], words: str
) -> None:
    address = unit.answer.unit
    if unit.settings is not None:
        url = str(with_settings(Endpoint.parse(url), unit.settings))
    identity = await identify_modbus(url, address, profiles, timeout_s=IDENTIFY_TIMEOUT_S)
    best = _best(identity.candidates)
    if best is not None or address == 0:
        _take(found, f"unit {address}", url, address, best, names)
        return
    name = f"unit_{address}"
    try:
        text = await draft(url, address, name, words)
    except (FileInvalid, WireError, Unreachable) as e:
        found.remarks.append(f"unit {address}: no profile fits, and no draft is possible, so it is left out ({e})")
        return
    found.devices.append(DeviceWish(name, name, url, address, text))
    found.remarks.append(
        f"unit {address}: no profile fits; profiles/{name}.yaml is a draft of input and holding registers 0 to 499, "
        "to compare with the manual"
    )


async def draft(url: str, address: int, name: str, words: str) -> str:
    """Return the text of a draft profile, from several passes over the first registers of a Modbus unit."""
    job = DumpJob(
        DeviceTarget(url, address, timeout_s=IDENTIFY_TIMEOUT_S),
        spans=register_spans(DRAFT_RANGES),
        passes=DRAFT_PASSES,
        every_s=DRAFT_EVERY_S,
        functions=False,
        budget_s=DRAFT_BUDGET_S,
    )
    with tempfile.TemporaryDirectory(prefix="fieldtwin-new-") as folder:
        out = Path(folder) / "dump.jsonl"
        await dump(job, out, words=words)
        dumps = [load_dump(out)]
    return draft_profile(infer(series_of(dumps)), dumps, name)


def _best(candidates: list[Candidate]) -> Candidate | None:
    """Return the one candidate that fits best, if it is at least likely and no other is equally sure."""
    likely = [c for c in candidates if c.sureness in (Sureness.CERTAIN, Sureness.LIKELY)]
    surest = [c for c in likely if c.sureness is Sureness.CERTAIN] or likely
    return surest[0] if len(surest) == 1 else None


def _take(found: Scanned, what: str, url: str, address: int, best: Candidate | None, names: dict[str, str]) -> None:
    if best is None:
        found.remarks.append(f"{what}: no profile fits, and it is left out; write a profile, then add it with --device")
        return
    if not address >= 1:
        found.remarks.append(f"{what}: left out; a device of a system needs an address from 1 on")
        return
    found.devices.append(DeviceWish(names[best.profile], "", url, address))
    sure = "" if best.sureness is Sureness.CERTAIN else "; likely, not certain: compare it with the manual"
    found.remarks.append(f"{what}: {best.profile}{sure}")


def _reference(profile: DeviceProfile) -> str:
    """Return the name by which a system file can refer to the profile: the name of a shipped profile, else its path."""
    path = Path(profile.path)
    return path.stem if is_shipped(path) else str(path)
