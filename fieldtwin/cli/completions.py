"""Values that the shell offers for arguments: names of systems, and IDs that `fieldtwin explain` knows.

The shell calls the program at each press of the tab key, so each function reads no more than it needs.
"""

from __future__ import annotations

from pathlib import Path

import click
from click.shell_completion import CompletionItem


def systems(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the names of systems in the search path that begin with `incomplete`, and otherwise files."""
    from fieldtwin.twin.site.data_files import search_path

    folders = [folder for place in search_path() for folder in (place, place / "systems")]
    names = {path.stem for folder in folders for path in folder.glob("*.yaml") if "." not in path.stem}
    found = sorted(name for name in names if name.startswith(incomplete))
    return [CompletionItem(name) for name in found] or [CompletionItem(incomplete, type="file")]


def explained(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the IDs without spaces that `fieldtwin explain` knows and that begin with `incomplete`. Upper and lower case are
    equal."""
    from fieldtwin.explain.lookup import everything

    wanted = incomplete.lower()
    entries = (entry for entry in everything() if " " not in entry.id and entry.id.lower().startswith(wanted))
    return [CompletionItem(entry.id, help=f"{entry.kind}: {entry.title}") for entry in entries]


def st_warnings(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the ids of the warnings of Structured Text that begin with `incomplete`, and ``all``."""
    from fieldtwin.plc.st.dialects import FINDINGS, WARNINGS

    known = {**WARNINGS, **FINDINGS, "all": "all of them"}
    return [CompletionItem(id, help=title) for id, title in known.items() if id.lower().startswith(incomplete.lower())]


def script_of(shell: str, program: click.Command) -> str:
    """Return the script that makes `shell` (bash, zsh or fish) complete the program's commands, options and arguments."""
    from click.shell_completion import get_completion_class

    made = get_completion_class(shell)
    assert made is not None
    return made(program, {}, "fieldtwin", "_FIELDTWIN_COMPLETE").source()


def place_of(shell: str, home: Path, data: Path | None = None, config: Path | None = None) -> Path:
    """Return the file from which `shell` loads the completion of `fieldtwin` by itself.

    `data` and `config` are XDG_DATA_HOME and XDG_CONFIG_HOME, if they are set.
    """
    if shell == "bash":
        return (data or home / ".local/share") / "bash-completion/completions/fieldtwin"
    if shell == "fish":
        return (config or home / ".config") / "fish/completions/fieldtwin.fish"
    return home / ".zfunc" / "_fieldtwin"
