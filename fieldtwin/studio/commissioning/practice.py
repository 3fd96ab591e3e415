"""The known device profiles. With an emulator of one of them, the commissioning guide can be tried without hardware."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.twin.site.data_files import search_path

MOST_PROFILES = 200


@dataclass(frozen=True)
class KnownProfile:
    """A profile of the search path, with the protocol and the unit ID or node ID at which its emulator answers."""

    name: str
    device: str
    protocol: str
    address: int


def profile_names() -> frozenset[str]:
    """Return the names of the device profiles in the search path."""
    return frozenset(path.stem for folder in search_path() for path in (folder / "devices").glob("*.yaml"))


def known_profiles() -> tuple[KnownProfile, ...]:
    """Return the profiles, at most `MOST_PROFILES`. A profile that cannot be read is left out; `identify` reports it."""
    paths = [path for folder in search_path() for path in sorted((folder / "devices").glob("*.yaml"))]
    return _loaded(tuple((path, path.stat().st_mtime_ns) for path in paths))


@lru_cache(maxsize=1)
def _loaded(files: tuple[tuple[Path, int], ...]) -> tuple[KnownProfile, ...]:
    """Load the profiles of these files. Their times of change are part of the argument, so that a changed file is read again."""
    found: dict[str, KnownProfile] = {}
    for path, _ in files:
        try:
            profile = load_profile(path)
        except FileInvalid:
            continue
        factory = profile.form.factory
        address = factory.unit if profile.protocol == "modbus" else factory.node
        found.setdefault(path.stem, KnownProfile(path.stem, profile.name, profile.protocol, address or 1))
    return tuple(found[name] for name in sorted(found)[:MOST_PROFILES])
