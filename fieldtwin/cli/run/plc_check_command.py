"""`fieldtwin plc check`: compile programs without running anything, and list every error."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldtwin.cli.completions import systems
from fieldtwin.cli.option_groups import group
from fieldtwin.cli.options import json_option
from fieldtwin.cli.template_question import TemplateSearchOptions
from fieldtwin.console import stdout
from fieldtwin.gateway.core.errors import FileInvalid, UsageError

if TYPE_CHECKING:
    from fieldtwin.plc.st.compiler.compile import CompiledUnit

_OF_SYSTEMS = (".yaml", ".yml")


@dataclass(frozen=True)
class _Found:
    """The compiled units, and the errors in those that cannot be compiled."""

    units: list[CompiledUnit]
    errors: list[FileInvalid]


@click.command("check")
@click.argument("source", shell_complete=systems)
@group("Options", sources=TemplateSearchOptions)
@json_option
def check(source: str, sources: TemplateSearchOptions, as_json: bool) -> int:
    """Compile SOURCE and list all errors, one per line, with file, line and column. Nothing is run.

    SOURCE is a file of Structured Text or PLCopen XML, a folder of such files, which are compiled together, or a system,
    whose programs are checked. A file or folder needs no system.

    \b
    fieldtwin plc check pump.st
    fieldtwin plc check plc/
    fieldtwin plc check observatory

    A part with a syntax error hides the errors of meaning in all others, and at most 51 errors of a unit are listed.
    Exit code 0 without errors, else 1.
    """
    found = _checked([Path(source)] if _is_program(source) else list(_sources_of(source, sources)))
    if as_json:
        click.echo(json.dumps(_as_json(found), indent=2))
        return 1 if found.errors else 0
    for error in found.errors:
        stdout.print(str(error), soft_wrap=True, markup=False)
    stdout.print(_summary(found), style="red" if found.errors else "green", soft_wrap=True, markup=False)
    return 1 if found.errors else 0


def _is_program(source: str) -> bool:
    """Return whether `source` is a file or folder of programs, and not the file or name of a system."""
    path = Path(source)
    return path.is_dir() or (path.exists() and path.suffix.lower() not in _OF_SYSTEMS)


def _sources_of(system: str, sources: TemplateSearchOptions) -> Iterator[Path]:
    """Return each file or folder of programs in Structured Text that a system has, once.

    Raises `UsageError` if it has none.
    """
    from fieldtwin.run.template import system_file
    from fieldtwin.twin.site.system import load_system

    loaded = load_system(system_file(system, sources.ask(), plant=True, profiles=sources.profiles), sources.profiles)
    forms = [form.source.partition(":") for form in loaded.plc.programs.values()]
    found = dict.fromkeys(loaded.path.parent / name for name, _, _ in forms if name.strip() != "python")
    if not found:
        raise UsageError(
            f"{system} has no program in Structured Text", hint="Python programs are checked by mypy or ruff"
        )
    yield from found


def _checked(paths: list[Path]) -> _Found:
    from fieldtwin.plc.st.project import compile_source

    found = _Found([], [])
    for path in paths:
        try:
            found.units.append(compile_source(path))
        except FileInvalid as e:
            found.errors.extend((e, *e.others))
    return found


def _summary(found: _Found) -> str:
    if found.errors:
        files = len({error.path for error in found.errors})
        return f"{_counted(len(found.errors), 'error')} in {_counted(files, 'file')}"
    files = sum(len(unit.files) for unit in found.units)
    names = Counter(kind for unit in found.units for kind in unit.kinds)
    parts = ", ".join(_counted(count, kind) for kind, count in sorted(names.items()))
    return f"{_counted(files, 'file')}, no errors: {parts or 'no declarations'}"


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _as_json(found: _Found) -> dict[str, object]:
    return {
        "kind": "fieldtwin plc check",
        "version": 1,
        "files": sorted({file for unit in found.units for file in unit.files}),
        "errors": [error.as_data() for error in found.errors],
    }
