"""A template in place of a system file: unpacked where runs live, verified, and asked about before anything of it runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gateway.core.errors import NotAllowed
from twin.data_files import template_of
from twin.instance import runtime_root
from twin.system import System, load_system
from twin.template import is_code
from twin.template_package import FolderPackage, Package, is_template, names_below, open_package, unpack


@dataclass(frozen=True, slots=True)
class Stranger:
    """What a template brings that somebody has to agree to: `code` are files that Python would run, `reach` says what its
    prototype uses of this computer (`twin.template_reach`)."""

    path: Path
    code: tuple[str, ...] = ()
    reach: tuple[str, ...] = ()


Ask = Callable[[Stranger], bool]
"""Asks somebody whether it may be run; says what came."""


def system_file(
    name: str, ask: Ask, *, plant: bool = False, virtual: bool = False, prototype_file: Path | None = None
) -> str:
    """`name` as it is, unless it is a template: then the system file in it, verified, and in a folder on this computer.

    A zip is unpacked once, into the folder where runs live, under its id. A `plant` has no use for the prototype in it, and in
    `virtual` time nothing is opened. A file inside of an unpacked template is asked about as the template is, and not verified:
    its owner may be at work on it. Raises `NotAllowed` when `ask` says no, `FileInvalid` when it is not what was packed.
    """
    path = Path(name)
    if is_template(path):
        with open_package(path) as package:
            folder = path if path.is_dir() else _unpacked(package)
        here = FolderPackage(folder)
        here.verify()
        from twin.template_check import examine  # where a template is there to examine, what reads it is installed

        system = examine(folder, here.manifest, plant=plant)
        code, file = here.code, str(folder / here.manifest.system_file)
    elif path.is_file() and (inside := template_of(path.resolve())):
        system = load_system(name)
        code, file = tuple(found for found in names_below(inside[0]) if is_code(found)), name
    else:
        return name
    reaches = () if plant or virtual else _reach(system, prototype_file)
    if (code or reaches) and not ask(Stranger(path, code, reaches)):
        raise NotAllowed("nothing of this template was run", where=str(path), hint="--trust says yes beforehand")
    return file


def _reach(system: System, prototype_file: Path | None) -> tuple[str, ...]:
    from twin.prototype_file import load_prototype, prototype_path  # a plant has no emulators installed
    from twin.template_reach import reach

    file = prototype_file or prototype_path(system)
    return reach(system, load_prototype(system, file)) if file.is_file() else ()


def _unpacked(package: Package) -> Path:
    """The folder with the contents of a zip. What is unpacked already does not excuse a zip that was damaged since."""
    folder = runtime_root() / "templates" / package.manifest.id[:32]
    if folder.exists():
        package.verify()
    else:
        runtime_root().mkdir(parents=True, exist_ok=True, mode=0o700)
        folder.parent.mkdir(exist_ok=True, mode=0o700)
        unpack(package, folder)
    return folder
