"""`fieldtwin profile`: convert device descriptions of other tools to profiles, and profiles to such descriptions."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import click
from rich.table import Table

from fieldtwin.cli.losses import show_losses
from fieldtwin.cli.options import json_option, pairs, profiles_option
from fieldtwin.cli.output_files import write_bytes, write_text
from fieldtwin.console import stderr, stdout
from fieldtwin.descriptions.conversion import MAX_DESCRIPTION_BYTES, Loss, Source
from fieldtwin.descriptions.formats import FORMATS, check_settings, exporter, format_named, importer
from fieldtwin.descriptions.profile_text import checked_profile, profile_text
from fieldtwin.gateway.core.errors import CheckFailed, FileInvalid
from fieldtwin.gateway.core.files.input_file import read_input, reading
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.twin.site.data_files import find

_set_option = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="KEY=VALUE",
    help="A setting of the format; `profile formats` lists them.",
)
_strict_option = click.option(
    "--strict",
    is_flag=True,
    help="A loss is an error: write nothing, and end with exit code 1. Parts listed as `not converted` are permitted.",
)


@click.group("profile")
def command() -> None:
    """Convert device descriptions of other tools to profiles, and back.

    Each conversion lists on stderr what the result does not have of the input.
    """


@command.command("import")
@click.argument("format_name", metavar="FORMAT")
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "-o", "--out", type=click.Path(dir_okay=False, path_type=Path), help="The new profile; default: print it on stdout."
)
@_set_option
@_strict_option
@json_option
def import_command(
    format_name: str, file: Path, out: Path | None, settings: tuple[str, ...], strict: bool, as_json: bool
) -> int:
    """Convert FILE, a device description of this FORMAT, to a profile.

    Files that the profile needs, such as its EDS, are written into the folder of the profile. No file is replaced.
    """
    row = format_named(format_name)
    chosen = pairs(settings, "--set")
    check_settings(chosen, row.import_settings, row)
    convert = importer(row)
    with reading(file):
        source = Source(file, read_input(file, MAX_DESCRIPTION_BYTES), file.stat().st_mtime_ns)
    result = convert(source, chosen)
    text = profile_text(result.profile, f"Imported by `fieldtwin profile import {row.name}` from {file.name}.")
    checked_profile(text, str(out or "the new profile"))
    if not as_json:
        for repair in result.repairs:
            stderr.print(f"repaired: {repair}", soft_wrap=True, markup=False)
        show_losses(result.losses)
    _refuse_losses(result.losses, strict)
    written: list[str] = []
    if out is not None:
        written = _write(out, text, result.files)
    if as_json:
        losses = [asdict(loss) for loss in result.losses]
        found = {"profile": text, "files": written, "repairs": list(result.repairs), "losses": losses}
        click.echo(json.dumps(found, ensure_ascii=False))
    elif out is None:
        click.echo(text, nl=False)
        if result.files:
            stderr.print(f"the profile needs {', '.join(result.files)} in its folder: -o writes both", soft_wrap=True)
    else:
        stderr.print(f"{out}: {len(result.profile.tags)} tags", soft_wrap=True, markup=False)
    return 0


@command.command("export")
@click.argument("format_name", metavar="FORMAT")
@click.argument("profile")
@click.option(
    "-o", "--out", type=click.Path(dir_okay=False, path_type=Path), help="The description; default: print it on stdout."
)
@_set_option
@_strict_option
@profiles_option
@json_option
def export_command(
    format_name: str,
    profile: str,
    out: Path | None,
    settings: tuple[str, ...],
    strict: bool,
    profiles: tuple[Path, ...],
    as_json: bool,
) -> int:
    """Convert PROFILE, a file or the name of a profile, to a device description of this FORMAT."""
    row = format_named(format_name)
    chosen = pairs(settings, "--set")
    check_settings(chosen, row.export_settings, row)
    result = exporter(row)(load_profile(find("devices", profile, extra=profiles)), chosen)
    if not as_json:
        show_losses(result.losses)
    _refuse_losses(result.losses, strict)
    if out is not None:
        write_bytes(out, result.content)
    if as_json:
        found = {"file": None if out is None else str(out), "losses": [asdict(loss) for loss in result.losses]}
        click.echo(json.dumps(found, ensure_ascii=False))
    elif out is None:
        click.echo(result.content, nl=False)
    else:
        stderr.print(f"{out}: {len(result.content):,} bytes", soft_wrap=True, markup=False)
    return 0


@command.command("formats")
@json_option
def formats_command(as_json: bool) -> int:
    """List the formats: their files, directions, extras and settings."""
    if as_json:
        click.echo(json.dumps([asdict(row) for row in FORMATS.values()], ensure_ascii=False))
        return 0
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("format", "file", "import", "export", "extra", "what it holds", "--set"):
        table.add_column(name, overflow="fold")
    for row in FORMATS.values():
        settings = ", ".join(dict.fromkeys([*row.import_settings, *row.export_settings]))
        directions = ("yes" if row.imports else "no", "yes" if row.exports else "no")
        table.add_row(row.name, row.suffix, *directions, row.extra or "-", f"{row.title}: {row.holds}", settings)
    stdout.print(table)
    return 0


def _refuse_losses(losses: tuple[Loss, ...], strict: bool) -> None:
    lost = sum(not loss.note for loss in losses)
    if strict and lost:
        count = "1 part of the input" if lost == 1 else f"{lost} parts of the input"
        raise CheckFailed(
            f"the result would lack {count}", hint="without --strict the conversion is done, and lists them"
        )


def _write(out: Path, text: str, files: Mapping[str, bytes]) -> list[str]:
    """Write the profile and its files. Raises `FileInvalid` if the profile exists, or a file with another content."""
    if out.exists():
        raise FileInvalid(
            "the file already exists", path=str(out), hint="an import replaces no file: choose another name"
        )
    wanted = {out.parent / name: data for name, data in files.items()}
    for path, data in wanted.items():
        if path.exists() and (path.stat().st_size != len(data) or path.read_bytes() != data):
            raise FileInvalid(
                "the file already exists, with another content",
                path=str(path),
                hint="write the profile into another folder",
            )
    for path, data in wanted.items():
        if not path.exists():
            write_bytes(path, data)
    write_text(out, text)
    return [str(out), *map(str, wanted)]
