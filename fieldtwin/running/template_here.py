"""A template in place of a system file: unpacked where runs live, verified, and asked about before its control logic runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from gateway.core.errors import NotAllowed
from twin.instance import runtime_root
from twin.template_package import FolderPackage, Package, is_template, open_package, unpack

Ask = Callable[[Package], bool]
"""Asks somebody whether what a template brings may be run; says what came."""


def system_file(name: str, ask: Ask, *, plant: bool = False) -> str:
    """`name` as it is, unless it is a template: then the system file in it, verified, and in a folder on this computer.

    A zip is unpacked once, into the folder where runs live, under its id. A `plant` has no use for the prototype in it. Raises
    `NotAllowed` when the template brings control logic in Python and `ask` says no, `FileInvalid` when it is not what was packed.
    """
    path = Path(name)
    if not is_template(path):
        return name
    with open_package(path) as package:
        folder = path if path.is_dir() else _unpacked(package)
    here = FolderPackage(folder)
    here.verify()
    if here.code and not ask(here):
        raise NotAllowed("nothing of this template was run", where=str(path), hint="--trust says yes beforehand")
    from twin.template_check import examine  # where a template is there to examine, what reads it is installed

    examine(folder, here.manifest, plant=plant)
    return str(folder / here.manifest.system_file)


def _unpacked(package: Package) -> Path:
    folder = runtime_root() / "templates" / package.manifest.id[:32]
    if not folder.exists():
        runtime_root().mkdir(parents=True, exist_ok=True, mode=0o700)
        folder.parent.mkdir(exist_ok=True, mode=0o700)
        unpack(package, folder)
    return folder
