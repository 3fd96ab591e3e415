"""The argument SOURCE of commands that read programs: a file or folder of programs, or a system, with its options."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fieldtwin.cli.template_question import TemplateSearchOptions
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.st.dialects import DIALECTS, Dialect, dialect_of

if TYPE_CHECKING:
    from fieldtwin.twin.site.system import System

StSource = tuple[Path, Dialect, tuple[Path, ...]]
"""A file or folder of programs, its dialect, and its libraries."""
StSources = tuple[Path | tuple[Path, ...], Dialect, tuple[Path, ...]]
"""The same, or several files and folders that are compiled together."""
_TOGETHER = "files and folders of programs, which are compiled together"
_OF_SYSTEMS = (".yaml", ".yml")

dialect_option: Callable[[Any], Any] = click.option(
    "--dialect",
    type=click.Choice(list(DIALECTS)),
    help="The dialect of a file or folder (default: standard). A system states the dialect of each program.",
)
library_option: Callable[[Any], Any] = click.option(
    "--library",
    "libraries",
    type=click.Path(path_type=Path, exists=True),
    multiple=True,
    help="A file or folder whose declarations SOURCE may use; only those that it uses are compiled. Can be repeated.",
)


def source_file(source: str, dialect: str | None, libraries: tuple[Path, ...]) -> StSource | None:
    """Return `source` if it is a file or folder of programs; None if it is the file or name of a system, or a template.

    Raises `UsageError` for a system with a dialect or libraries, which its file states.
    """
    from fieldtwin.twin.template.detect import is_template

    path = Path(source)
    if not is_template(path) and (path.is_dir() or (path.exists() and path.suffix.lower() not in _OF_SYSTEMS)):
        return path, dialect_of(dialect or "standard"), libraries
    if dialect is not None or libraries:
        expected = "`dialect:` and `libraries:` of the program in the system file"
        raise UsageError(f"--dialect or --library for the system {source}", expected=expected)
    return None


def source_files_together(
    sources: tuple[str, ...], dialect: str | None, libraries: tuple[Path, ...]
) -> StSources | None:
    """Return `source_file` of one source, or several files and folders that are compiled together.

    Raises `UsageError` if one of several is not a file or folder of programs.
    """
    if len(sources) == 1:
        return source_file(sources[0], dialect, libraries)
    for source in sources:
        if not Path(source).exists():
            raise UsageError(f"no file or folder {source!r}", expected=_TOGETHER)
        if source_file(source, None, ()) is None:
            hint = f"check the system alone: fieldtwin plc check {source}"
            raise UsageError(f"several sources, and {source} is not a program", expected=_TOGETHER, hint=hint)
    return tuple(map(Path, sources)), dialect_of(dialect or "standard"), libraries


def agreed_system(system: str, sources: TemplateSearchOptions) -> System:
    """Return a system whose programs are read, after the user has agreed to this. Nothing is opened."""
    from fieldtwin.run.template import system_file
    from fieldtwin.twin.site.system import load_system

    return load_system(system_file(system, sources.ask(), plant=True, profiles=sources.profiles), sources.profiles)


def st_tasks(system: System) -> dict[StSources, dict[str, str]]:
    """Return the sources in Structured Text of a system, each once, with the task of each PROGRAM in it that the PLC runs.

    Names of a PROGRAM are in lower case; "" stands for the only one of a source.
    """
    first = next(iter(system.plc.tasks), "main")
    found: dict[StSources, dict[str, str]] = {}
    for name, source in st_sources(system).items():
        form = system.plc.programs[name]
        found.setdefault(source, {})[form.source.partition(":")[2].strip().lower()] = form.task or first
    return found


def st_sources(system: System) -> dict[str, StSource]:
    """Return the source of each program in Structured Text of a system, by the name of the program."""
    forms = {name: (form.source.partition(":")[0].strip(), form) for name, form in system.plc.programs.items()}
    folder = system.path.parent
    return {
        name: (folder / file, dialect_of(form.dialect), tuple(folder / library for library in form.libraries))
        for name, (file, form) in forms.items()
        if file != "python"
    }
