"""`fieldtwin template`: pack a system into one file, check, unpack and compare such files."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import click
from rich.markup import escape

from fieldtwin.__about__ import __version__
from fieldtwin.cli.options import json_option, profiles_option
from fieldtwin.cli.system.template_aasx import from_aasx_command, to_aasx_command
from fieldtwin.cli.template_question import ask_about, code_of
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.escaping import escape_controls
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.template import ForeignParts
from fieldtwin.twin.prototype.file import prototype_path
from fieldtwin.twin.site.system import load_system
from fieldtwin.twin.template.check import (
    TemplateDifference,
    differences,
    examine,
    put_together,
    software_difference,
    unified,
)
from fieldtwin.twin.template.pack import TemplateExtras, collect, pack
from fieldtwin.twin.template.package import FolderPackage, open_package, unpack
from fieldtwin.twin.template.software import modules_hash
from fieldtwin.twin.template.template import DOCUMENTS, DocumentKind, Manifest

KINDS: dict[str, DocumentKind] = {kind: kind for kind in DOCUMENTS}


@click.group("template")
def command() -> None:
    """Pack a system and all its files into one file; check, compare and unpack such files.

    A template has the system file, profiles, EDS files, control logic, recordings, the digital model, the version and hash of
    the control software, and documents. `fieldtwin run T.zip --prototype` needs no other file.
    """


command.add_command(to_aasx_command)
command.add_command(from_aasx_command)


@command.command("pack")
@click.argument("system")
@click.option(
    "-o", "--out", required=True, type=click.Path(path_type=Path), help="The template: FILE.zip, or a new folder."
)
@click.option(
    "--prototype-file", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="Use this prototype file."
)
@click.option(
    "--document", "documents", multiple=True, metavar="KIND=FILE", help="A document: " + ", ".join(KINDS) + "."
)
@click.option(
    "--wheel", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="Include this wheel of fieldtwin."
)
@profiles_option
@json_option
def pack_command(
    system: str,
    out: Path,
    prototype_file: Path | None,
    documents: tuple[str, ...],
    wheel: Path | None,
    profiles: tuple[Path, ...],
    as_json: bool,
) -> int:
    """Pack SYSTEM and every file that it names into a template. Equal files give an identical template."""
    loaded = load_system(system, profiles)
    beside = prototype_path(loaded)
    collected = collect(loaded, profiles, prototype_file or (beside if beside.is_file() else None))
    manifest = pack(loaded, collected, TemplateExtras(_documents(documents), wheel), __version__, out)
    if as_json:
        _print_json({"template": str(out), **_described(manifest)})
        return 0
    total = sum(file.bytes for file in manifest.files)
    stderr.print(
        f"{escape(str(out))}: {len(manifest.files)} files, {total:,} bytes; template {manifest.id[:16]}", soft_wrap=True
    )
    if not manifest.prototype_file:
        stderr.print("it has no prototype file, so it runs only as a plant")
    return 0


def _documents(values: tuple[str, ...]) -> dict[DocumentKind, tuple[Path, ...]]:
    found: dict[DocumentKind, tuple[Path, ...]] = {}
    for value in values:
        kind, equals, name = value.partition("=")
        if kind not in KINDS or not equals:
            raise UsageError("a document", expected="KIND=FILE with a kind of " + ", ".join(KINDS), got=value)
        if not Path(name).is_file():
            raise UsageError("no such document", got=name)
        found[KINDS[kind]] = (*found.get(KINDS[kind], ()), Path(name))
    return found


@command.command("unpack")
@click.argument("template", type=click.Path(exists=True, path_type=Path))
@click.option("-o", "--out", type=click.Path(path_type=Path), help="The folder; default: the template's name, here.")
@json_option
def unpack_command(template: Path, out: Path | None, as_json: bool) -> int:
    """Unpack TEMPLATE to a folder. Every file is compared with its hash; no code of the template runs."""
    out = out or Path(template.stem)
    with open_package(template) as package:
        unpack(package, out)
        manifest = package.manifest
    if as_json:
        _print_json({"folder": str(out), **_described(manifest)})
        return 0
    stderr.print(
        f"{escape(str(out))}: {len(manifest.files)} files, as packed; template {manifest.id[:16]}", soft_wrap=True
    )
    for code in code_of(manifest.code):
        stderr.print(f"not run: {code}. Read it, or know its author, before you run it.", soft_wrap=True)
    return 0


@command.command("check")
@click.argument("template", type=click.Path(exists=True, path_type=Path))
@click.option("--trust", is_flag=True, help="Import the template's control logic in Python without asking.")
@json_option
def check_command(template: Path, trust: bool, as_json: bool) -> int:
    """Check that TEMPLATE is complete: every hash, every file that its system names, and that a prototype can start.

    Control logic in Python is imported only after a confirmation; without one, the rest is checked.
    """
    with open_package(template) as package, tempfile.TemporaryDirectory() as place:
        if package.path.is_dir():
            package.verify()
            folder = package.path
        else:
            folder = Path(place) / "template"
            unpack(package, folder)
        here = FolderPackage(folder)
        manifest = here.manifest
        system = examine(folder, manifest, shown=package.path)
        may_run = not here.code or trust or (not as_json and ask_about(ForeignParts(package.path, package.code)))
        if may_run:
            put_together(manifest, system, folder, WallClock())
    same = manifest.software.modules_sha256 == modules_hash()
    if as_json:
        _print_json({**_described(manifest), "ok": True, "control_logic_checked": may_run, "same_software_here": same})
        return 0
    _print_files(manifest)
    stderr.print("every hash is correct, and no file of the system is missing")
    if not may_run:
        stderr.print("its control logic was not checked")
    if not same:
        there = f"{manifest.software.version}, modules {manifest.software.modules_sha256[:12]}"
        here_is = f"{__version__}, modules {modules_hash()[:12]}"
        stderr.print(f"it was packed by a different version: {there}; this is {here_is}", soft_wrap=True)
    return 0


@command.command("diff")
@click.argument("before", type=click.Path(exists=True, path_type=Path))
@click.argument("after", type=click.Path(exists=True, path_type=Path))
@click.option("--names", is_flag=True, help="Show only the names of the different files.")
@json_option
def diff_command(before: Path, after: Path, names: bool, as_json: bool) -> int:
    """Compare two templates: zip files, folders, or one of each. Exit code 1 if they differ.

    The files of a folder are compared in their present, possibly edited, state; those of a zip as they were packed. A damaged
    zip is rejected.
    """
    with open_package(before, edited=True) as a, open_package(after, edited=True) as b:
        old, new = a.contents(), b.contents()
        found = [*software_difference(a.manifest.software, b.manifest.software), *differences(old, new)]
        if as_json:
            _print_json(
                [{"path": d.path, "kind": d.kind, "what": d.what, "before": d.before, "after": d.after} for d in found]
            )
            return 1 if found else 0
        for difference in found:
            _print_difference(difference)
            path = difference.path
            if not names and difference.kind != "software":
                for line in unified(path, (a, old.get(path)), (b, new.get(path))):
                    stdout.print(escape_controls(line), style=_style(line), markup=False, soft_wrap=True)
    if not found:
        stderr.print("no difference")
    return 1 if found else 0


def _print_difference(d: TemplateDifference) -> None:
    def short(side: str) -> str:
        version, _, digest = side.rpartition(" ")
        return f"{version} {digest[:12]}".strip() or "nothing"

    style = {"added": "green", "removed": "red", "changed": "yellow"}[d.what]
    stdout.print(f"[{style}]{d.what:8}[/] {escape(d.path)}  {short(d.before)} -> {short(d.after)}", soft_wrap=True)


def _style(line: str) -> str:
    return "green" if line.startswith("+") else "red" if line.startswith("-") else "dim" if line.startswith("@") else ""


def _print_files(manifest: Manifest) -> None:
    stdout.print(
        f"{manifest.system}: template {manifest.id[:16]}, fieldtwin {manifest.software.version}", soft_wrap=True
    )
    stdout.print(f"  {'SHA-256':12}  {'bytes':>13}  {'kind':17}  file")
    for file in manifest.files:  # the path is printed last and not wrapped, so that it can be copied
        words = f"  {file.sha256[:12]}  {file.bytes:13,}  {file.document or file.kind:17}  {escape(file.path)}"
        stdout.print(words, soft_wrap=True, highlight=False)


def _described(manifest: Manifest) -> dict[str, Any]:
    described: dict[str, Any] = json.loads(manifest.to_json())
    return {"id": manifest.id, **described}


def _print_json(value: object) -> None:
    json.dump(value, sys.stdout, indent=1)
    sys.stdout.write("\n")
