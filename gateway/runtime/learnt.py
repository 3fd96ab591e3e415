"""What devices taught about their gaps, kept from run to run, and said so that it can go into their profiles.

One JSON file in the run directory. An entry counts for the device it was learnt from only: same profile (by its hash), same
endpoint, same unit. A file that cannot be read, or says anything else than what is written here, is as good as none: the
devices teach it again. It must never know a wire.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.gateway.core.profile import RegisterRange, gap_text, resolve_gap
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.gateway.devices.read_plan import Learnt
from fieldtwin.gateway.devices.register_device import RegisterDriver

MOST_BYTES = 4_000_000
"""No file of ours is larger; one that is, is not read."""


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One device. `gaps` as a profile has them; `borders`, of no registers, by the address that they stand before."""

    profile: str
    endpoint: str
    unit: int
    gaps: list[str]
    borders: list[str]
    missing: list[str]


class LearntFile:
    """The file at `path`, for `drivers` on `buses`. `load` before they are used; `save` now and then."""

    def __init__(self, path: Path, drivers: Iterable[RegisterDriver], buses: Mapping[str, BusConfig]) -> None:
        self._path = path
        self._drivers = list(drivers)
        self._buses = buses
        self._saved = 0

    def load(self) -> None:
        """Give every driver what its device taught before."""
        try:
            with self._path.open("rb") as file:
                entries = msgspec.json.decode(file.read(MOST_BYTES), type=dict[str, Entry])
        except (OSError, msgspec.DecodeError):
            return  # none yet, or not one of ours: it is learnt again, and written anew
        for driver in self._drivers:
            entry = entries.get(driver.config.name)
            if entry is not None and self._same(driver, entry):
                learnt = _learnt(driver, entry)
                if learnt is not None:
                    driver.know(learnt)

    def save(self) -> None:
        """Write the file if something was learnt since. Raises `Unreachable` when the disk refuses."""
        changes = sum(driver.learnt.changes for driver in self._drivers)
        if changes == self._saved:
            return
        entries = {d.config.name: self._entry(d) for d in self._drivers if d.learnt.gaps or d.learnt.missing}
        new = self._path.with_suffix(".new")
        try:
            with os.fdopen(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
                file.write(msgspec.json.encode(entries))
            new.replace(self._path)
        except OSError as e:
            raise Unreachable(f"cannot write what was learnt: {e.strerror}", where=str(self._path)) from e
        self._saved = changes

    def _same(self, driver: RegisterDriver, entry: Entry) -> bool:
        return entry.profile == driver.profile.hash and (entry.endpoint, entry.unit) == self._place(driver)

    def _place(self, driver: RegisterDriver) -> tuple[str, int]:
        return str(self._buses[driver.config.bus].endpoint), driver.config.address

    def _entry(self, driver: RegisterDriver) -> Entry:
        learnt = driver.learnt
        endpoint, unit = self._place(driver)
        return Entry(
            driver.profile.hash,
            endpoint,
            unit,
            [gap_text(g) for g in learnt.profile_gaps],
            [f"{g.table}:{g.address}" for g in learnt.gaps if not g.count],
            list(learnt.missing),
        )


def _learnt(driver: RegisterDriver, entry: Entry) -> Learnt | None:
    """What an entry says; None where it makes no sense."""
    try:
        gaps = [resolve_gap(text, "sent") for text in entry.gaps]
        borders = [resolve_gap(text, "sent") for text in entry.borders]
    except ValueError:
        return None
    if not set(entry.missing) <= set(driver.profile.tags):
        return None
    gaps += [RegisterRange(b.table, b.address, 0) for b in borders]
    return Learnt(gaps, list(entry.missing))


def describe_learnt(drivers: Iterable[object]) -> dict[str, Any]:
    """Of every device that taught something: `gaps`, `borders`, `missing` tags, and `line`, which goes into its profile
    in place of the `gaps` there ("" where nothing of it belongs there)."""
    found: dict[str, Any] = {}
    for driver in drivers:
        if isinstance(driver, RegisterDriver) and (driver.learnt.gaps or driver.learnt.missing):
            learnt, profile = driver.learnt, driver.profile
            gaps = [gap_text(g) for g in learnt.profile_gaps]
            found[driver.config.name] = {
                "profile": profile.name,
                "gaps": gaps,
                "borders": [f"{g.table}:{g.address}" for g in learnt.gaps if not g.count],
                "missing": list(learnt.missing),
                "line": f"gaps: {json.dumps([*profile.form.gaps, *gaps])}" if gaps else "",
            }
    return found
