"""The files of a campaign for workers on other computers: the files of the template of each system, and what names them.

A scenario and a file of several systems refer to their systems by relative paths, so the files keep their positions relative to
each other and to the working directory. Equal files give an equal bundle, whose ID is the SHA-256 of its bytes.
"""

from __future__ import annotations

import hashlib
import io
import os
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.twin.prototype.group import SystemGroup
from fieldtwin.twin.site.data_files import TEMPLATE, data_root, search_path, template_of
from fieldtwin.twin.template.pack import collect

MAX_BUNDLE_BYTES = 64 << 20
"""Largest size of a bundle, and of the sum of its files, in bytes. Every worker receives it once."""
_EPOCH = (1980, 1, 1, 0, 0, 0)
"""The time of all files in a bundle: equal contents give equal bytes. It is the earliest time that a zip can have."""


@dataclass(frozen=True, slots=True)
class Bundle:
    """Files as the bytes of a zip. `cwd` is the place of the working directory in it, and `shipped` has the SHA-256 of each of
    these files that is shipped with fieldtwin, by its path in fieldtwin's data.
    """

    id: str
    data: bytes
    cwd: str
    shipped: tuple[tuple[str, str], ...]


def files_of(group: SystemGroup, profiles: Iterable[Path]) -> tuple[Path, ...]:
    """Return all files that the prototypes of a group read. Raises `FileInvalid` for one that a template cannot have."""
    profiles = tuple(profiles)
    found = [group.path] if group.kind else []
    for member in group.members.values():
        files = collect(member.system, profiles, member.prototype.path).items.values()
        found += [item.source for item in files if item.source is not None]
        found += [folder / TEMPLATE for folder in template_of(member.system.path)]
    return tuple(found)


def relative(path: Path) -> Path:
    """Return a path relative to the working directory; a relative path stays as it is."""
    if not path.is_absolute():
        return path
    try:
        return Path(os.path.relpath(path))
    except ValueError as e:  # Windows
        raise UsageError(
            "a campaign on a cluster needs all files on the drive of the working directory", got=str(path)
        ) from e


def profile_folders(profiles: Iterable[Path]) -> tuple[Path, ...]:
    """Return the folders that the option and the environment variable name for profiles, relative to the working directory.

    A worker has neither of them.
    """
    everywhere = search_path()[-2:] if Path("profiles").is_dir() else search_path()[-1:]
    return tuple(relative(folder) for folder in search_path(profiles) if folder not in everywhere)


def bundle(files: Iterable[Path]) -> Bundle:
    """Read the files and return them as a bundle. Raises `FileInvalid`, `UsageError`."""
    places = {os.path.abspath(path): path for path in files}
    here = os.getcwd()
    try:
        root = os.path.commonpath([here, *map(os.path.dirname, places)])
    except ValueError as e:  # Windows
        raise UsageError("a campaign on a cluster needs all files on one drive", where=here) from e
    names = {os.path.relpath(place, root).replace(os.sep, "/"): path for place, path in places.items()}
    shipped, out, total = {}, io.BytesIO(), 0
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(names):
            data = _read(names[name])
            total += len(data)
            if total > MAX_BUNDLE_BYTES:
                raise FileInvalid(
                    "the files of this campaign are too large for a cluster",
                    path=str(names[name]),
                    expected=f"at most {MAX_BUNDLE_BYTES >> 20} MiB in all",
                    hint="use --shard on computers that have the files",
                )
            entry = zipfile.ZipInfo(name, _EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, data)
            if (at := names[name].resolve()).is_relative_to(data_root()):
                shipped[at.relative_to(data_root()).as_posix()] = hashlib.sha256(data).hexdigest()
    cwd = os.path.relpath(here, root).replace(os.sep, "/")
    packed = out.getvalue()
    return Bundle(hashlib.sha256(packed).hexdigest(), packed, cwd, tuple(sorted(shipped.items())))


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as e:
        raise FileInvalid(f"cannot read: {e.strerror}", path=str(path)) from e


def unpack(packed: Bundle, folder: Path) -> Path:
    """Write the files of a bundle into an empty folder, and return the folder that takes the place of the working directory.

    Raises `FileInvalid` if the bytes are not those of the ID.
    """
    if hashlib.sha256(packed.data).hexdigest() != packed.id:
        raise FileInvalid("the files of the campaign changed on their way to this worker", path=str(folder))
    with zipfile.ZipFile(io.BytesIO(packed.data)) as archive:
        archive.extractall(folder)
    cwd = folder / packed.cwd
    cwd.mkdir(parents=True, exist_ok=True)
    return cwd
