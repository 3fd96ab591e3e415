"""`fieldtwin check site`: check all files of a site and every reference between them."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldtwin.cli.options import json_option
from fieldtwin.console import show_warnings, stdout
from fieldtwin.gateway.core.errors import UsageError

if TYPE_CHECKING:
    from fieldtwin.site.check import SiteCheck


@click.command("site")
@click.argument("folder", metavar="[DIR]", default=".", type=click.Path(exists=True, path_type=Path))
@click.option(
    "--profiles",
    multiple=True,
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    metavar="DIR",
    help="Search this folder for device profiles first; repeatable.",
)
@json_option
def site(folder: Path, profiles: tuple[Path, ...], as_json: bool) -> int:
    """Check all files in DIR (default: the working directory) without running anything: systems, prototypes, scenarios,
    profiles, networks, faults, rules and waivers, and the services of compose files that run fieldtwin.

    Every error is reported in one run, one per line, with file, line and column: for example each reference to a device,
    a bus, a tag or a program that was renamed or removed. The references to and from a file with an unknown key or a wrong
    type are checked once that file is corrected. Files of other programs, such as CI files, are left out.

    Exit code 0 without errors, else 1.
    """
    if folder.is_file():
        raise UsageError(
            f"{str(folder)!r} is a file, and a site is checked as a whole", expected=f"its folder: {folder.parent}"
        )
    from fieldtwin.cli import command_lines
    from fieldtwin.site.check import check_site

    found = check_site(folder, profiles, command_lines)
    if as_json:
        click.echo(json.dumps(_as_json(found), indent=2))
    else:
        show_warnings(found.warnings)
        for error in found.errors:
            stdout.print(str(error), soft_wrap=True, markup=False)
        stdout.print(_summary(found), style="red" if found.errors else "green", soft_wrap=True, markup=False)
    return 1 if found.errors else 0


def _summary(found: SiteCheck) -> str:
    kinds = Counter(found.files.values())
    checked = ", ".join(
        f"{count} {kind}{'s' if count > 1 and kind[-1] != 's' else ''}" for kind, count in kinds.items()
    )
    wrong = len({error.path for error in found.errors})
    if not found.errors:
        return f"no errors in {len(found.files)} files: {checked}"
    errors = "1 error" if len(found.errors) == 1 else f"{len(found.errors)} errors"
    return f"{errors} in {wrong} of {len(found.files)} files"


def _as_json(found: SiteCheck) -> dict[str, object]:
    return {
        "kind": "fieldtwin site check",
        "version": 1,
        "folder": str(found.folder),
        "files": [{"path": path, "kind": kind} for path, kind in found.files.items()],
        "errors": [error.as_data() for error in found.errors],
        "warnings": found.warnings,
    }
