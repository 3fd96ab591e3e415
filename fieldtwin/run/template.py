"""A template in place of a system file: it is unpacked into the folder of the runs and verified, and the user is asked before
any of its code runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.gateway.core.errors import NotAllowed, UsageError
from fieldtwin.twin.plant.instance import runtime_root
from fieldtwin.twin.site.data_files import find, template_of
from fieldtwin.twin.site.system import System, load_system
from fieldtwin.twin.template.detect import MANIFEST, is_template
from fieldtwin.twin.template.pack import OUR_PROGRAMS
from fieldtwin.twin.template.package import FolderPackage, Package, names_below, open_package, unpack
from fieldtwin.twin.template.template import MAX_MANIFEST_BYTES, is_code


@dataclass(frozen=True, slots=True)
class ForeignParts:
    """The parts of a template that need the user's consent.

    `code` are files that Python would run, `reach` lists the resources of this computer that its prototype uses
    (`fieldtwin.twin.template.reach`).
    """

    path: Path
    code: tuple[str, ...] = ()
    reach: tuple[str, ...] = ()


Ask = Callable[[ForeignParts], bool]
"""Shows the contents of a template to the user, and asks whether it may be run."""


def system_file(
    name: str,
    ask: Ask,
    *,
    plant: bool = False,
    virtual: bool = False,
    prototype_file: Path | None = None,
    profiles: Iterable[Path] = (),
) -> str:
    """Return `name` unchanged, unless it is a template: then the verified system file in it, in a folder on this computer.

    A zip is unpacked once, into the folder of the runs, under its ID. A `plant` does not use the prototype in it, and
    in `virtual` time no endpoint is opened. A file inside an unpacked template needs the same consent as the template,
    but is not verified: its owner may be editing it. The same applies to a prototype file inside one. Raises
    `NotAllowed` when `ask` denies, `FileInvalid` when the content differs from what was packed.
    """
    path, profiles = Path(name), tuple(profiles)
    if not is_template(path):
        try:
            found = find("systems", name, extra=profiles)
        except UsageError:
            return name  # the later reader of the file reports the error in it
        if _templates_above(found, prototype_file):
            agree(ask, path, [(load_system(name, profiles), prototype_file)], plant=plant, virtual=virtual)
        return name
    with open_package(path) as package:
        folder = path if path.is_dir() else _unpacked(package)
    here = FolderPackage(folder)
    here.verify()
    from fieldtwin.twin.template.check import (
        examine,  # the module that reads templates is only installed together with them
    )

    system = examine(folder, here.manifest, plant=plant, shown=path)
    agree(ask, path, [(system, prototype_file)], plant=plant, virtual=virtual)
    return str(folder / here.manifest.system_file)


def agree(
    ask: Ask,
    shown: Path,
    systems: Iterable[tuple[System, Path | None]],
    *,
    beside: Path | None = None,
    opens: Iterable[str] = (),
    plant: bool = False,
    virtual: bool = False,
) -> None:
    """Ask the user once about everything in unpacked templates.

    This is the only place where consent to foreign files is given. `systems` are pairs of a system and its prototype file; None
    stands for the prototype file next to the system file. `beside` is a file that names them, a scenario's or a network's, and
    `opens` lists the endpoints that it opens itself, if it is from a template. The user is not asked if all files are the user's
    own. Call it before any of them is run: assembling a process image imports programs. Raises `NotAllowed`.
    """
    code: dict[str, None] = {}
    reaches: dict[str, None] = {}
    for system, said in systems:
        file = None if plant else said or _beside(system)
        folders = _templates_above(system.path, file, beside)
        for folder in folders:
            code |= dict.fromkeys(name for name in names_below(folder) if is_code(name))
        if folders:
            code |= dict.fromkeys(_elsewhere(system))
        if folders and file is not None:
            said_there, uses = _of_prototype(system, file, folders)
            code |= dict.fromkeys(said_there)
            reaches |= dict.fromkeys(() if virtual else uses)
    if beside is not None and _templates_above(beside):
        reaches |= dict.fromkeys(opens)
    if (code or reaches) and not ask(ForeignParts(shown, tuple(code), tuple(reaches))):
        raise NotAllowed(
            "nothing of this template was run", where=str(shown), hint="--trust gives the consent beforehand"
        )


def _templates_above(*files: Path | None) -> list[Path]:
    """Return the folders of the templates that contain these files, directly or in subfolders."""
    found: dict[Path, None] = {}
    for file in files:
        if file is not None and file.is_file():
            near = file.resolve()
            found |= dict.fromkeys([*template_of(near), *(folder for folder in near.parents if _is_unpacked(folder))])
    return list(found)


def _is_unpacked(folder: Path) -> bool:
    try:
        with (folder / MANIFEST).open("rb") as file:
            return b'"fieldtwin_template"' in file.read(MAX_MANIFEST_BYTES)
    except OSError:
        return False


def _elsewhere(system: System) -> tuple[str, ...]:
    """Return the Python programs that are neither fieldtwin's nor in the template.

    Their use of this computer was not checked. A template has none of them when it is packed.
    """
    sources = [form.source.partition(":") for form in system.plc.programs.values()]
    modules = [rest.strip().partition(":")[0].strip() for kind, _, rest in sources if kind.strip() == "python"]
    return tuple(
        f"the module {name}"
        for name in modules
        if (top := name.partition(".")[0]) != OUR_PROGRAMS
        and not (system.path.parent / f"{top}.py").is_file()
        and not (system.path.parent / top).is_dir()
    )


def _beside(system: System) -> Path | None:
    from fieldtwin.twin.prototype.file import prototype_path  # a plant has no emulators installed

    file = prototype_path(system)
    return file if file.is_file() else None


def _of_prototype(system: System, file: Path, folders: Iterable[Path]) -> tuple[list[str], tuple[str, ...]]:
    """Return the Python simulations and FMUs from outside the templates, and the resources of this computer that the prototype
    uses.
    """
    from fieldtwin.twin.prototype.file import load_prototype
    from fieldtwin.twin.template.reach import reach

    prototype = load_prototype(system, file)
    simulations = prototype.form.simulations.values()
    named = [form.python.rpartition(":")[0] for form in simulations if form.python is not None]
    named += [form.fmu for form in simulations if form.fmu is not None]
    sources = [(file.parent / name).resolve() for name in named]
    outside = [str(source) for source in sources if not any(source.is_relative_to(folder) for folder in folders)]
    return outside, reach(system, prototype)


def _unpacked(package: Package) -> Path:
    """Return the folder with the contents of a zip file.

    An existing folder does not hide later damage to the zip: it is verified.
    """
    folder = runtime_root() / "templates" / package.manifest.id[:32]
    if folder.exists():
        package.verify()
    else:
        runtime_root().mkdir(parents=True, exist_ok=True, mode=0o700)
        folder.parent.mkdir(exist_ok=True, mode=0o700)
        unpack(package, folder)
    return folder
