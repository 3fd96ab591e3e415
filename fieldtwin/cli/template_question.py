"""Ask before code from a template runs. `fieldtwin run --plant` asks as well, so this module does not import emulators."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.markup import escape

from fieldtwin.cli.option_groups import option
from fieldtwin.cli.options import PROFILES
from fieldtwin.console import stderr

if TYPE_CHECKING:  # the reader of systems needs 0.4 s of CPU time, and `fieldtwin plc check FILE` reads none
    from fieldtwin.run.template import Ask, ForeignParts

SHOWN = 5
TRUST: dict[str, Any] = {
    "is_flag": True,
    "help": "Do not ask before running a template's code and opening its endpoints.",
}
"""The arguments of the option --trust."""


@dataclass(frozen=True)
class TemplateSearchOptions:
    """The folders in which profiles and systems are searched first, and the user's consent to a template's code."""

    profiles: tuple[Path, ...] = option("--profiles", **PROFILES)
    trust: bool = option("--trust", **TRUST)

    def ask(self, *, runs_code: bool = True) -> Ask:
        """Return the function that obtains consent: it asks the user at the terminal, or consents because of --trust or
        because no code is run.
        """
        return lambda template: self.trust or not runs_code or ask_about(template)


def shown(what: tuple[str, ...], between: str = ", ") -> str:
    """Return the first `SHOWN` names, and the number of the rest, as text."""
    more = f"{between}and {len(what) - SHOWN} more" if len(what) > SHOWN else ""
    return escape(between.join(what[:SHOWN])) + more


def code_of(files: tuple[str, ...]) -> list[str]:
    """Return what a message calls the code files of a template: control logic, and FMUs if there are any."""
    native = tuple(file for file in files if file.lower().endswith(".fmu"))
    python = tuple(file for file in files if file not in native)
    texts = [f"control logic in Python: {shown(python)}"] if python else []
    return texts + ([f"FMUs, which are native code: {shown(native)}"] if native else [])


def ask_about(template: ForeignParts) -> bool:
    """Print what a template contains and ask whether it may run. Without a terminal the answer counts as no."""
    for code in code_of(template.code):
        stderr.print(
            f"{escape(str(template.path))} contains {code}.\n"
            "When run, this program can do everything on this computer that you can do.",
            soft_wrap=True,
        )
    if template.reach:
        lines = shown(template.reach, "\n  ")
        stderr.print(
            f"{escape(str(template.path))} affects more than its run directory as a prototype:\n  {lines}",
            soft_wrap=True,
        )
    if not sys.stdin.isatty():
        return False
    return click.confirm("Run it?", default=False, err=True)
