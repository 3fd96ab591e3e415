"""Packs a template: all files that a system names, found where a run would find them, under paths that are independent of this
computer.

A package has ``systems/``, ``devices/``, ``recordings/``, ``documents/`` and ``software/``. A file that the system file
names by a relative path keeps its position relative to it. A file that it names by a bare name is packed into the folder in
which bare names are looked up (`fieldtwin.twin.site.data_files`). The system file itself is never changed: plant, prototype
and template have the same bytes.
"""

from __future__ import annotations

import ast
import hashlib
import os
import posixpath
import shutil
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from fieldtwin.gateway.core.errors import FileInvalid, Unreachable, UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.plc.source_files import source_files
from fieldtwin.twin.site.data_files import find
from fieldtwin.twin.site.system import System
from fieldtwin.twin.template.detect import MANIFEST
from fieldtwin.twin.template.software import modules_hash, wheel_hash
from fieldtwin.twin.template.template import (
    DocumentKind,
    Kind,
    Manifest,
    Software,
    TemplateFile,
    check_path,
    describe_model,
)

MODEL = "model.json"
OUR_PROGRAMS = "fieldtwin"
"""The package whose programs are part of fieldtwin itself."""


@dataclass(frozen=True, slots=True)
class Item:
    """A file to pack: its kind, and the source of its bytes, which is either a file or generated `data`."""

    kind: Kind
    source: Path | None
    data: bytes = b""
    document: DocumentKind = ""

    def blocks(self) -> Iterator[bytes]:
        if self.source is None:
            yield self.data
            return
        try:
            with self.source.open("rb") as file:
                while block := file.read(1 << 20):
                    yield block
        except OSError as e:
            raise FileInvalid(f"cannot read: {e.strerror}", path=str(self.source)) from e


@dataclass
class Collected:
    """The files that a system needs, by their paths in the package."""

    system_file: str
    prototype_file: str = ""
    items: dict[str, Item] = field(default_factory=dict)

    def add(self, path: str, item: Item) -> None:
        """Add a file. Raises `FileInvalid` for a path outside the package, or two files for one path."""
        check_path(path, str(item.source or path))
        old = self.items.setdefault(path, item)
        if old.source is not None and item.source is not None and old.source.resolve() != item.source.resolve():
            raise FileInvalid(f"two files for {path}", path=str(item.source), expected="one", got=f"also {old.source}")


def collect(system: System, profiles: Iterable[Path] = (), prototype: Path | None = None) -> Collected:
    """Return every file that `system` names, and every file that `prototype` names if it is given.

    Raises `FileInvalid` for a file that cannot be placed in a package.
    """
    got = Collected(f"systems/{system.path.name}")
    got.add(got.system_file, Item("system", system.path))
    for name, device in system.devices.items():
        form = system.file.section("devices")[name]
        _profile(got, system.path, form["profile"], device.profile)
        if dcf := form.get("dcf"):
            got.add(_place("devices", dcf, system.path), Item("dcf", find("devices", dcf, system.path, profiles)))
    texts = [name for program in system.plc.programs.values() for name in (program.source, *program.libraries)]
    for source in dict.fromkeys(texts):
        _program(got, system.path, source)
    if prototype is not None:
        _prototype(got, system, prototype)
    got.add(MODEL, Item("model", None, describe_model(system)))
    return got


def _place(folder: str, reference: str, named_in: Path) -> str:
    """Return the path in the package of the file that `named_in` calls `reference`: relative to `named_in` if it is
    found there, else where bare names are searched.
    """
    path = PurePosixPath(reference)
    if path.is_absolute():
        raise FileInvalid(
            f"{reference!r} is a path of this computer",
            path=str(named_in),
            expected="a path relative to the file, or a plain name",
        )
    if len(path.parts) == 1 and not (named_in.parent / reference).is_file():
        return f"{folder}/{reference}"
    return posixpath.normpath(f"systems/{reference}")


def _profile(got: Collected, named_in: Path, reference: str, profile: DeviceProfile) -> None:
    found = Path(profile.path)
    place = _place("devices", reference, named_in)
    if place.startswith("devices/") and "/" not in reference:
        place = f"devices/{found.name}"
    got.add(place, Item("profile", found))
    if profile.form.eds is not None and profile.eds_path is not None:
        got.add(
            posixpath.normpath(posixpath.join(posixpath.dirname(place), profile.form.eds)),
            Item("eds", profile.eds_path),
        )


def _prototype(got: Collected, system: System, path: Path) -> None:
    # Imported here: a system with a prototype has emulators installed.
    from fieldtwin.twin.prototype.file import load_prototype

    prototype = load_prototype(system, path)
    got.prototype_file = f"systems/{system.path.stem}.prototype.yaml"
    got.add(got.prototype_file, Item("prototype", path))
    for device in prototype.devices.values():
        if device.form.recording is not None and device.recording is not None:
            got.add(_place("recordings", device.form.recording, path), Item("recording", device.recording))
        if device.form.profile is not None:
            _profile(got, path, device.form.profile, device.profile)
    for simulation in prototype.form.simulations.values():
        if simulation.fmu is not None:
            got.add(_place("systems", simulation.fmu, path), Item("program", path.parent / simulation.fmu))
        if simulation.python is not None:
            name = simulation.python.rpartition(":")[0]
            source = path.parent / name
            got.add(_place("systems", name, path), Item("program", source))
            for imported in _imports(source):
                _python(got, path.parent, imported)


# -- control logic ------------------------------------------------------------------------------------------------------


def _program(got: Collected, system: Path, source: str) -> None:
    language, _, rest = source.partition(":")
    if language.strip() == "python":
        module = rest.strip().partition(":")[0].strip()
        if not _python(got, system.parent, module) and module.partition(".")[0] != OUR_PROGRAMS:
            raise FileInvalid(
                f"the program {source!r} is installed on this computer and is not part of the system", path=str(system),
                expected="a module next to the system file", hint="move it there, so that the template can hold it",
            )  # fmt: skip
        return
    name = source.strip().partition(":")[0]
    beside = system.parent / name
    found = beside if beside.exists() else Path(name)
    for file in source_files(found):
        below = file.relative_to(found).as_posix()
        place = _place("systems", name, system) if below == "." else _place("systems", f"{name}/{below}", system)
        got.add(place, Item("program", file))


def _python(got: Collected, folder: Path, module: str) -> bool:
    """Add a module from the system file's folder, and the modules of that folder that it imports.

    Return False if `folder` does not contain it. No code is run.
    """
    top = module.partition(".")[0]
    package, single = folder / top, folder / f"{top}.py"
    if package.is_dir() and (any(package.glob("*.py"))):
        files = [f for f in sorted(package.rglob("*.py")) if "__pycache__" not in f.parts]
    elif single.is_file():
        files = [single]
    else:
        return False
    for path in files:
        place = f"systems/{path.relative_to(folder).as_posix()}"
        if place not in got.items:
            got.add(place, Item("program", path))
            for imported in _imports(path):
                _python(got, folder, imported)
    return True


def _imports(path: Path) -> Iterator[str]:
    try:
        tree = ast.parse(path.read_bytes(), str(path))
    except (SyntaxError, ValueError, OSError, RecursionError) as e:
        raise FileInvalid(f"not Python: {e}", path=str(path)) from e
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module


# -- writing ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class TemplateExtras:
    """Files in a template that its system does not name: documents by kind, and the wheel of the control software."""

    documents: Mapping[DocumentKind, tuple[Path, ...]] = field(default_factory=dict)
    wheel: Path | None = None


def pack(system: System, collected: Collected, extras: TemplateExtras, version: str, target: Path) -> Manifest:
    """Write the template: a zip if `target` ends in ``.zip``, else a folder. `version` is that of the control software.

    Raises `FileInvalid` for a file that changes meanwhile or a wheel of other software, and `Unreachable` if the template
    cannot be written.
    """
    local_hash = modules_hash()
    wheel = _add_wheel(collected, extras.wheel, version, local_hash) if extras.wheel else ""
    for kind, paths in extras.documents.items():
        for path in paths:
            collected.add(f"documents/{kind}/{path.name}", Item("document", path, document=kind))
    manifest = Manifest(
        version=1,
        system=system.name,
        system_file=collected.system_file,
        prototype_file=collected.prototype_file,
        software=Software(version=version, modules_sha256=local_hash, wheel=wheel),
        files=tuple(_described(path, item) for path, item in sorted(collected.items.items())),
    )
    try:
        if target.suffix == ".zip":
            _write_zip(manifest, collected, target)
        else:
            _write_folder(manifest, collected, target)
    except OSError as e:
        raise Unreachable(f"cannot write the template: {e.strerror or e}", where=str(target)) from e
    return manifest


def _add_wheel(collected: Collected, wheel: Path, version: str, local_hash: str) -> str:
    its_version, its_hash = wheel_hash(wheel)
    if its_hash != local_hash:
        raise FileInvalid(
            "this wheel is different software from the running one", path=str(wheel),
            expected=f"{version}, modules {local_hash[:12]}", got=f"{its_version}, modules {its_hash[:12]}",
        )  # fmt: skip
    place = f"software/{wheel.name}"
    collected.add(place, Item("software", wheel))
    return place


def _described(path: str, item: Item) -> TemplateFile:
    digest, size = hashlib.sha256(), 0
    for block in item.blocks():
        digest.update(block)
        size += len(block)
    return TemplateFile(path=path, kind=item.kind, document=item.document, bytes=size, sha256=digest.hexdigest())


def _write_zip(manifest: Manifest, collected: Collected, target: Path) -> None:
    work = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        with zipfile.ZipFile(work, "x", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
            archive.writestr(_entry(MANIFEST), manifest.to_json())
            for file in manifest.files:
                with archive.open(_entry(file.path), "w") as out:
                    for block in _same(file, collected.items[file.path]):
                        out.write(block)
        work.replace(target)
    finally:
        work.unlink(missing_ok=True)


def _entry(path: str) -> zipfile.ZipInfo:
    """Return a zip entry without this computer's dates and modes, so that equal templates are equal byte by byte."""
    entry = zipfile.ZipInfo(path, (1980, 1, 1, 0, 0, 0))
    entry.compress_type = zipfile.ZIP_DEFLATED
    entry.create_system = 3
    entry.external_attr = 0o100644 << 16
    return entry


def _write_folder(manifest: Manifest, collected: Collected, target: Path) -> None:
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise UsageError("the folder is not empty", got=str(target), expected="a new one, or FILE.zip")
    target.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    try:
        for file in manifest.files:
            place = work / file.path
            place.parent.mkdir(parents=True, exist_ok=True)
            with place.open("xb") as out:
                for block in _same(file, collected.items[file.path]):
                    out.write(block)
        (work / MANIFEST).write_bytes(manifest.to_json())
        if target.exists():
            target.rmdir()
        work.chmod(0o755)
        work.rename(target)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _same(file: TemplateFile, item: Item) -> Iterator[bytes]:
    """Yield the file's blocks again. Raises `FileInvalid` at the end if it has changed since it was hashed."""
    digest = hashlib.sha256()
    for block in item.blocks():
        digest.update(block)
        yield block
    if digest.hexdigest() != file.sha256:
        raise FileInvalid("changed while it was packed", path=str(item.source), hint="pack again")
