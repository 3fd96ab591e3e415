"""Finds shipped data: in the installed wheel if it holds a copy, otherwise in the checkout.

Profiles and systems are searched in this order: the folders given by an option, FIELDTWIN_PROFILES, ./profiles, the
shipped ones. A file inside a template searches the template first, because a template is complete and refers to its own
files.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean

MAX_BYTES = 8 * 1024 * 1024
MOST_LISTED = 8
"""The most files of a folder that a message lists."""
# the path is not resolved yet, because in a checkout fieldtwin/twin is a link
_HERE = Path(__file__).absolute().parents[3].resolve()
"""The folder site-packages if a wheel is installed, otherwise the checkout."""


def data_root(base: Path = _HERE) -> Path:
    """Return the folder that holds `profiles` and `recordings`."""
    for candidate in (base / "fieldtwin" / "_data", base):
        if (candidate / "profiles").is_dir() and (candidate / "recordings").is_dir():
            return candidate
    raise UsageError("the shipped profiles are missing", where=str(base), hint="reinstall fieldtwin")


TEMPLATE = "template.json"
"""The file name of the manifest, which is at the top of a template's folder (`fieldtwin.twin.template.template`)."""


def template_of(file: Path | None) -> list[Path]:
    """Return the folder of the template that contains `file`, as a list of one; an empty list if no template contains it."""
    above = list(file.parents)[1:2] if file is not None else []
    return [folder for folder in above if (folder / TEMPLATE).is_file()]


def search_path(extra: Iterable[Path] = ()) -> list[Path]:
    """Return the folders that may hold `devices`, `systems` and `recordings`, in the order in which they are searched."""
    folders = [Path(p) for p in extra]
    folders += [Path(p) for p in os.environ.get("FIELDTWIN_PROFILES", "").split(os.pathsep) if p]
    folders += [Path("profiles"), data_root() / "profiles"]
    return [f for f in folders if f.is_dir()]


def device_files(folder: Path) -> list[Path]:
    """Return the device profiles of a folder of the search path: those in its subfolder `devices`, and those in the folder
    itself.
    """
    return [*sorted((folder / "devices").glob("*.yaml")), *_with_key(folder, "device")]


def system_files(folder: Path) -> list[Path]:
    """Return the files in a folder that describe a system."""
    return _with_key(folder, "system")


def _with_key(folder: Path, key: str) -> list[Path]:
    """Return the YAML files of a folder with this key at the top level, and without that of a scenario."""
    found = []
    for path in sorted([*folder.glob("*.yaml"), *folder.glob("*.yml")]):
        if not path.is_file():
            continue
        try:
            with path.open("rb") as file:
                keys = {line.partition(b":")[0] for line in file.read(MAX_BYTES).splitlines() if line[:1].isalpha()}
        except OSError:
            continue
        if key.encode() in keys and b"scenario" not in keys:
            found.append(path)
    return found


def find(kind: str, name: str, beside: Path | None = None, extra: Iterable[Path] = ()) -> Path:
    """Return the file that `name` refers to: a path, or a bare name in the search path. `kind` is ``systems`` or
    ``devices``.

    `beside` is the file that contains the reference: a relative path is first looked up in the folder of that file. A
    folder stands for the only system file in it. Raises `UsageError`, which lists the available names.
    """
    direct = Path(name)
    places = [beside.parent / direct] if beside else []
    if direct.name == name:
        places += [folder / kind / file for folder in template_of(beside) for file in (f"{name}.yaml", name)]
    for candidate in (*places, direct):
        if candidate.is_file():
            return candidate
    folders = search_path(extra)
    if direct.name == name:
        for folder in folders:
            for sub in (folder / kind, folder):
                for candidate in (sub / f"{name}.yaml", sub / name):
                    if candidate.is_file():
                        return candidate
    if kind == "systems" and direct.is_dir():
        return _only_system(direct)
    known = sorted({p.stem for f in folders for p in (f / kind).glob("*.yaml") if "." not in p.stem})
    if direct.exists() and not direct.is_dir():
        raise UsageError(f"{name!r} is not a regular file", expected=f"a {kind[:-1]}'s file")
    if direct.name != name or direct.suffix in (".yaml", ".yml"):
        key = "system" if kind == "systems" else "device"
        folder = (beside.parent / direct if beside else direct).parent
        there = [str(direct.parent / path.name) for path in _with_key(folder, key)]
        expected = f"a {kind[:-1]}'s file, or one of " + ", ".join(there[:MOST_LISTED] or known)
        raise UsageError(f"there is no file {name!r}", expected=expected, hint=did_you_mean(str(name), there))
    files = [f.name for f in (Path(f"{name}.yaml"), Path(f"{name}.yml")) if f.is_file()]
    raise UsageError(
        f"no {kind[:-1]} {name!r}",
        expected="a file, or one of " + ", ".join(known),
        hint=f"did you mean {files[0]!r}?" if files else did_you_mean(direct.name, known),
    )


def _only_system(folder: Path) -> Path:
    found = system_files(folder)
    if len(found) == 1:
        return found[0]
    if found:
        names = " or ".join(str(path) for path in found)
        raise UsageError(f"this folder has {len(found)} system files", where=str(folder), expected=names)
    raise UsageError(
        "no system file in this folder",
        where=str(folder),
        expected="a system file, or a folder with one",
        hint="`fieldtwin new DIR` writes a site",
    )


def find_recording(name: str, beside: Path | None = None) -> Path:
    """Return a recording by path: in the folder of the file that names it, in its template, in ./recordings, or shipped."""
    folders = [beside.parent] if beside else []
    folders += [folder / "recordings" for folder in template_of(beside)]
    folders += [Path(), Path("recordings"), data_root() / "recordings"]
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    raise UsageError(f"no recording {name!r}", expected="a file; searched " + ", ".join(str(f) for f in folders))
