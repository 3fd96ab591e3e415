"""Profiles that can stand for a device: with an emulator of one of them the guide can be tried without hardware."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.twin.site.data_files import search_path

MOST_PROFILES = 200


@dataclass(frozen=True)
class PracticeDevice:
    """A Modbus profile of the search path, with the unit ID at which its emulator answers."""

    name: str
    device: str
    unit: int


def profile_names() -> frozenset[str]:
    """Return the names of the device profiles in the search path."""
    return frozenset(path.stem for folder in search_path() for path in (folder / "devices").glob("*.yaml"))


@lru_cache(maxsize=1)
def practice_devices() -> tuple[PracticeDevice, ...]:
    """Return the Modbus profiles, at most `MOST_PROFILES`. A profile that cannot be read is left out; `identify` reports it."""
    found: dict[str, PracticeDevice] = {}
    for folder in search_path():
        for path in sorted((folder / "devices").glob("*.yaml")):
            try:
                profile = load_profile(path)
            except FileInvalid:
                continue
            if profile.protocol == "modbus":
                found.setdefault(path.stem, PracticeDevice(path.stem, profile.name, profile.form.factory.unit or 1))
    return tuple(found[name] for name in sorted(found)[:MOST_PROFILES])
