"""Identifies the control software: one hash over its modules, the same in a checkout, in an installation, and in its
wheel.

Two machines with the same hash run the same program, whatever their version numbers are. Shipped profiles and
recordings are data and have their own hashes.
"""

from __future__ import annotations

import hashlib
import os
import re
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid

PACKAGE = "fieldtwin"
HERE = Path(__file__).absolute().parents[3]
"""The folder that holds the package. Not resolved: in a checkout fieldtwin/twin is a link to a folder outside the package."""
MAX_MODULE_BYTES = 16 << 20
MAX_MODULES = 10_000
MAX_WHEEL_BYTES = 16 << 20
"""Largest packed size; the largest unpacked size is sixteen times that. A fieldtwin wheel has a tenth of this size, and an
untrusted wheel may be a zip bomb.
"""
_DATA = f"{PACKAGE}/_data/"
_NO_SOURCE = re.compile(r"(^|/)__pycache__/|\.pyc$|(^|/)\.")
"""Files that Python or the operating system creates next to modules, and that are never in a fieldtwin wheel."""


def modules_hash(folder: Path = HERE) -> str:
    """Return the SHA-256 over the names and contents of all modules below `folder`, as 64 hexadecimal digits."""
    return _hash(_modules_below(folder))


def _modules_below(folder: Path) -> Iterator[tuple[str, bytes]]:
    for parent, _, files in os.walk(folder / PACKAGE, followlinks=True):  # follow the links of a checkout
        for path in (Path(parent, file) for file in files):
            name = path.relative_to(folder).as_posix()
            if not name.startswith(_DATA) and not _NO_SOURCE.search(name) and path.is_file():
                yield name, path.read_bytes()


def wheel_hash(wheel: Path) -> tuple[str, str]:
    """Return the version of a fieldtwin wheel, and the hash over the modules that it would install. Raises `FileInvalid`."""
    match = re.fullmatch(r"fieldtwin-([0-9A-Za-z.!+_]+)-[^-]+-[^-]+-[^-]+\.whl", wheel.name)
    if match is None:
        raise FileInvalid("no wheel of fieldtwin", path=str(wheel), expected="fieldtwin-VERSION-py3-none-any.whl")
    try:
        if wheel.stat().st_size > MAX_WHEEL_BYTES:
            raise FileInvalid(
                "too large for a wheel of fieldtwin", path=str(wheel), expected=f"{MAX_WHEEL_BYTES} bytes"
            )
        with zipfile.ZipFile(wheel) as archive:
            return match[1], _hash(_modules_in(archive, f"fieldtwin-{match[1]}.dist-info/"))
    except (OSError, zipfile.BadZipFile, NotImplementedError, RuntimeError, zlib.error) as e:
        raise FileInvalid(f"cannot read the wheel: {e}", path=str(wheel)) from e


def _modules_in(archive: zipfile.ZipFile, about: str) -> Iterator[tuple[str, bytes]]:
    """Yield everything that the wheel would install, except for shipped data and its metadata (`about`).

    A module of another package is included, because a fieldtwin wheel has none.
    """
    entries = archive.infolist()
    if len(entries) > MAX_MODULES:
        raise FileInvalid(
            "too many files for a wheel of fieldtwin", path=str(archive.filename), expected=f"{MAX_MODULES}"
        )
    room = 16 * MAX_WHEEL_BYTES
    for entry in entries:
        if not entry.is_dir() and not entry.filename.startswith((_DATA, about)):
            with archive.open(entry) as file:
                data = file.read(MAX_MODULE_BYTES + 1)
            room -= len(data)
            if len(data) > MAX_MODULE_BYTES or room < 0:
                raise FileInvalid("too large for a module", path=entry.filename, expected=f"{MAX_MODULE_BYTES} bytes")
            yield entry.filename, data


def _hash(modules: Iterable[tuple[str, bytes]]) -> str:
    lines = sorted(f"{name}\0{hashlib.sha256(data).hexdigest()}\n" for name, data in modules)
    return hashlib.sha256("".join(lines).encode()).hexdigest()
