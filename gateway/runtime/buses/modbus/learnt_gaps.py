"""The gaps of devices, found while polling: registers at which a device refuses reads, so that no read may cover them.

They are kept between runs, and reported so that users can add them to profiles.

They are in one JSON file in the run directory. An entry is used only for the device from which it was learnt: same
profile (by its hash), same endpoint, same unit ID. A file that cannot be read, or that has any other content, is
ignored: the gaps are learnt again.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import msgspec

from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.gateway.core.files.profile import RegisterRange, gap_text, resolve_gap
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.gateway.devices.read_plan import Learnt
from fieldtwin.gateway.devices.register_device import RegisterDriver
from fieldtwin.gateway.runtime.gateway_status import LearntStatus

MOST_BYTES = 4_000_000
"""The gateway never writes a larger file, and does not read one."""


class LearntGapsEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The file's entry for one device.

    `gaps` are written as in a profile. `borders` holds the addresses at which a new read has to begin, because the device
    accepts fewer registers per read than its profile states. `missing` are the tags that the device refuses.
    """

    profile: str
    endpoint: str
    unit: int
    gaps: list[str]
    borders: list[str]
    missing: list[str]


class LearntFile:
    """The file of learnt gaps at `path`, for `drivers` on `buses`.

    Call `load` before the drivers are used, and `save` repeatedly.
    """

    def __init__(self, path: Path, drivers: Iterable[RegisterDriver], buses: Mapping[str, BusConfig]) -> None:
        self._path = path
        self._drivers = list(drivers)
        self._buses = buses
        self._saved = 0

    def load(self) -> None:
        """Pass to every driver what earlier runs learnt about its device."""
        try:
            with self._path.open("rb") as file:
                entries = msgspec.json.decode(file.read(MOST_BYTES), type=dict[str, LearntGapsEntry])
        except (OSError, msgspec.DecodeError):
            # there is no file yet, or fieldtwin did not write it: the gaps are learnt again and the file is replaced
            return
        for driver in self._drivers:
            entry = entries.get(driver.config.name)
            if entry is not None and self._same(driver, entry):
                learnt = _learnt(driver, entry)
                if learnt is not None:
                    driver.know(learnt)

    def save(self) -> None:
        """Write the file if something was learnt since the last call. Raises `Unreachable` if the write fails."""
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
            raise Unreachable(f"cannot store the learnt gaps: {e.strerror}", where=str(self._path)) from e
        self._saved = changes

    def _same(self, driver: RegisterDriver, entry: LearntGapsEntry) -> bool:
        return entry.profile == driver.profile.hash and (entry.endpoint, entry.unit) == self._place(driver)

    def _place(self, driver: RegisterDriver) -> tuple[str, int]:
        return str(self._buses[driver.config.bus].endpoint), driver.config.address

    def _entry(self, driver: RegisterDriver) -> LearntGapsEntry:
        learnt = driver.learnt
        endpoint, unit = self._place(driver)
        return LearntGapsEntry(
            driver.profile.hash,
            endpoint,
            unit,
            [gap_text(g) for g in learnt.profile_gaps],
            [f"{g.table}:{g.address}" for g in learnt.gaps if not g.count],
            list(learnt.missing),
        )


def _learnt(driver: RegisterDriver, entry: LearntGapsEntry) -> Learnt | None:
    """Return the content of an entry, or None if it is invalid."""
    try:
        gaps = [resolve_gap(text, "sent") for text in entry.gaps]
        borders = [resolve_gap(text, "sent") for text in entry.borders]
    except ValueError:
        return None
    if not set(entry.missing) <= set(driver.profile.tags):
        return None
    gaps += [RegisterRange(b.table, b.address, 0) for b in borders]
    return Learnt(gaps, list(entry.missing))


def learnt_statuses(drivers: Iterable[object]) -> dict[str, LearntStatus]:
    """Return the gaps that the gateway has learnt, by device name. Devices without an entry are left out."""
    found: dict[str, LearntStatus] = {}
    for driver in drivers:
        if isinstance(driver, RegisterDriver) and (driver.learnt.gaps or driver.learnt.missing):
            learnt, profile = driver.learnt, driver.profile
            gaps = [gap_text(g) for g in learnt.profile_gaps]
            found[driver.config.name] = LearntStatus(
                profile=profile.name,
                gaps=gaps,
                borders=[f"{g.table}:{g.address}" for g in learnt.gaps if not g.count],
                missing=list(learnt.missing),
                line=f"gaps: {json.dumps([*profile.form.gaps, *gaps])}" if gaps else "",
            )
    return found
