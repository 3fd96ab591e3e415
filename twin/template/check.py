"""Checks that a template is complete, consistent and able to run by itself, and compares two templates.

It inspects a folder whose hashes were verified. It reads system file, profiles and prototype; it imports control logic
only where that was permitted.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.twin.site.system import System, load_system
from fieldtwin.twin.template.pack import MODEL, collect
from fieldtwin.twin.template.package import Content, Package
from fieldtwin.twin.template.software import wheel_hash
from fieldtwin.twin.template.template import DigitalTemplate, Manifest, Software, describe_model

TEXT = (".yaml", ".yml", ".st", ".xml", ".py", ".eds", ".dcf", ".json", ".md", ".txt", ".csv")
MAX_SHOWN_BYTES = 256 * 1024


def examine(folder: Path, manifest: Manifest, *, plant: bool = False, shown: Path | None = None) -> System:
    """Load the template's system and check that the template contains every file that the system names. Runs no control
    logic.

    With `plant` the prototype file and the files that it names are not checked: that requires emulators, which a plant
    need not have. `shown` is the template's path as its user knows it, if that is not `folder`. Raises `FileInvalid`
    for the first error.
    """
    where = str(shown or folder)
    system = load_system(str(folder / manifest.system_file))
    if system.name != manifest.system:
        raise FileInvalid(
            "the manifest and the system file differ", path=where, expected=manifest.system, got=system.name
        )
    prototype = folder / manifest.prototype_file if manifest.prototype_file and not plant else None
    needed = collect(system, prototype=prototype)
    files = manifest.by_path()
    top = folder.resolve()
    for path, item in needed.items.items():
        if path not in files or (item.source is not None and not item.source.resolve().is_relative_to(top)):
            raise FileInvalid(f"{path} is not in the template", path=where, expected="everything that its system names")
    if (folder / MODEL).read_bytes() != describe_model(system):
        raise FileInvalid(
            f"{MODEL} is not the digital model of its system",
            path=where,
            hint="pack the template again with this version",
        )
    if manifest.software.wheel:
        _check_wheel(folder, manifest, where)
    return system


def _check_wheel(folder: Path, manifest: Manifest, where: str) -> None:
    """Check that the wheel contains the software that the manifest names. None of it is run."""
    said, (version, modules) = manifest.software, wheel_hash(folder / manifest.software.wheel)
    if (version, modules) != (said.version, said.modules_sha256):
        raise FileInvalid(
            f"{said.wheel} is not the software that the manifest names", path=where,
            expected=f"{said.version}, modules {said.modules_sha256[:12]}", got=f"{version}, modules {modules[:12]}",
        )  # fmt: skip


def put_together(manifest: Manifest, system: System, folder: Path, clock: Clock) -> DigitalTemplate:
    """Build the template's control system, and its prototype if it has one, in the same way as a run does when it starts.

    This imports control logic in Python. Raises `FileInvalid`.
    """
    template = DigitalTemplate(manifest, system)
    if manifest.prototype_file:
        from fieldtwin.twin.prototype.file import load_prototype

        # Imported here: a plant has no emulators installed.
        from fieldtwin.twin.prototype.prototype import DigitalTwinPrototype

        DigitalTwinPrototype(system, load_prototype(system, folder / manifest.prototype_file), clock)
    return template


@dataclass(frozen=True, slots=True)
class TemplateDifference:
    """A file that differs between two templates. `before` and `after` are hashes, empty for a missing file."""

    path: str
    kind: str
    before: str
    after: str

    @property
    def what(self) -> str:
        return "added" if not self.before else "removed" if not self.after else "changed"


def differences(old: Mapping[str, Content], new: Mapping[str, Content]) -> list[TemplateDifference]:
    """Return the files that differ, by path."""
    found = []
    for path in sorted({*old, *new}):
        before, after = (side[path].sha256 if path in side else "" for side in (old, new))
        if before != after:
            kind = (new[path].kind if path in new else "") or (old[path].kind if path in old else "")
            found.append(TemplateDifference(path, kind, before, after))
    return found


def software_difference(before: Software, after: Software) -> list[TemplateDifference]:
    """Return the difference between the control software of two templates; an empty list if the modules are the same."""
    if before.modules_sha256 == after.modules_sha256:
        return []
    sides = (f"{software.version} {software.modules_sha256}" for software in (before, after))
    return [TemplateDifference("fieldtwin", "software", *sides)]


def unified(path: str, *sides: tuple[Package, Content | None]) -> Iterator[str]:
    """Yield the lines of a unified diff of one text file; nothing for other files, and for files of more than
    `MAX_SHOWN_BYTES`.

    `sides` are the two templates, each with the content that it has under `path`.
    """
    texts: list[list[str]] = []
    for package, content in sides:
        if content is not None and (not path.lower().endswith(TEXT) or content.bytes > MAX_SHOWN_BYTES):
            return
        try:
            texts.append(package.text(path).decode().splitlines() if content is not None else [])
        except UnicodeDecodeError:
            return
    yield from difflib.unified_diff(texts[0], texts[1], f"a/{path}", f"b/{path}", lineterm="")
