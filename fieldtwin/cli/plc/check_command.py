"""`fieldtwin plc check`: compile programs without running anything, and list every error."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import click

from fieldtwin.cli.completions import st_warnings, systems
from fieldtwin.cli.option_groups import group
from fieldtwin.cli.options import json_option
from fieldtwin.cli.plc.checking import Checked, checked
from fieldtwin.cli.plc.machine_code import translated
from fieldtwin.cli.plc.sources import (
    agreed_system,
    dialect_option,
    library_option,
    source_files_together,
    st_tasks,
)
from fieldtwin.cli.template_question import TemplateSearchOptions
from fieldtwin.console import stdout
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.st.dialects import chosen_ids


@click.command("check")
@click.argument("programs", metavar="SOURCE...", nargs=-1, required=True, shell_complete=systems)
@group(
    "Options",
    dialect_option,
    click.option(
        "--error",
        "as_errors",
        metavar="ID",
        multiple=True,
        shell_complete=st_warnings,
        help="Treat the warning ID (such as ST001), or all, as an error. Can be repeated.",
    ),
    library_option,
    click.option(
        "--machine-code",
        is_flag=True,
        help="Also list the statements that stay Python in a program with `machine_code: true`, and why.",
    ),
    sources=TemplateSearchOptions,
)
@json_option
def check(
    programs: tuple[str, ...],
    dialect: str | None,
    as_errors: tuple[str, ...],
    libraries: tuple[Path, ...],
    machine_code: bool,
    sources: TemplateSearchOptions,
    as_json: bool,
) -> int:
    """Compile SOURCE and list all errors and warnings, one per line, with file, line and column. Nothing is run.

    SOURCE is a file of Structured Text, PLCopen XML or TwinCAT, a folder of such files, which are compiled together, or a system,
    whose programs are checked. A file or folder needs no system. Several files and folders are compiled together.

    \b
    fieldtwin plc check pump.st
    fieldtwin plc check main.st blocks.st lib/
    fieldtwin plc check plc/ --dialect codesys --error ST002
    fieldtwin plc check observatory

    A warning marks a construct that only the dialect accepts (ST001 to ST011), or that is often a mistake (from ST101 on);
    `fieldtwin explain ST101` explains it. The comment `// fieldtwin: allow ST101: REASON`, in its line or the line above, accepts
    it. For a system, the bindings of its programs are checked too (ST111 to ST114); in the system file a comment begins with #.
    Parts of a PLCopen XML file that are not supported are listed too; they are errors only where a program uses them.

    A part with a syntax error hides the errors of meaning in all others, and at most 51 errors of a unit are listed.
    Exit code 0 without errors, else 1.
    """
    named = source_files_together(programs, dialect, libraries)
    ids = chosen_ids(as_errors)
    found = checked({named: {}}, ids) if named is not None else _checked_system(programs[0], sources, ids)
    in_machine_code = translated(found.units) if machine_code else []
    if as_json:
        more = {"machine_code": [program.as_data() for program in in_machine_code]} if machine_code else {}
        click.echo(json.dumps({**found.as_data(), **more}, indent=2))
        return 1 if found.errors else 0
    for error in found.errors:
        stdout.print(str(error), soft_wrap=True, markup=False)
    for warning in found.warnings:
        stdout.print(f"{warning}", style="yellow", soft_wrap=True, markup=False)
    for missing in found.missing():
        where = f"{missing.pos.path}:{missing.pos.line}:{missing.pos.column}"
        stdout.print(f"{where}: not imported: {missing.reason}", soft_wrap=True, markup=False)
    for line in (line for program in in_machine_code for line in program.lines()):
        stdout.print(line, soft_wrap=True, markup=False)
    stdout.print(_summary(found), style="red" if found.errors else "green", soft_wrap=True, markup=False)
    return 1 if found.errors else 0


def _checked_system(name: str, sources: TemplateSearchOptions, as_errors: frozenset[str]) -> Checked:
    """Check the programs of a system in Structured Text, and their bindings. Raises `UsageError` if it has none."""
    system = agreed_system(name, sources)
    programs = st_tasks(system)
    if not programs:
        raise UsageError(
            f"{name} has no program in Structured Text", hint="Python programs are checked by mypy or ruff"
        )
    return checked(programs, as_errors, (system,))


def _summary(found: Checked) -> str:
    warned = f", {_counted(len(found.warnings), 'warning')}" if found.warnings else ""
    if found.errors:
        files = len({error.path for error in found.errors})
        return f"{_counted(len(found.errors), 'error')} in {_counted(files, 'file')}{warned}"
    files = sum(len(unit.files) for unit in found.units)
    names = Counter(kind for unit in found.units for kind in unit.kinds)
    parts = ", ".join(_counted(count, kind) for kind, count in sorted(names.items()))
    missing = f", {len(found.missing())} not imported" if found.missing() else ""
    return f"{_counted(files, 'file')}, no errors{warned}: {parts or 'no declarations'}{missing}"


def _counted(count: int, what: str) -> str:
    plural = "es" if what.endswith("s") else "s"
    return f"{count} {what}{'' if count == 1 else plural}"
