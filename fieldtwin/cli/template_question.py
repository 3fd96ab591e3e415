"""Ask before code from a template runs. A plant asks as well, so this module does not import emulators."""

from __future__ import annotations

import sys

import click
from rich.markup import escape

from fieldtwin.console import stderr
from fieldtwin.run.template import Ask, ForeignParts

SHOWN = 5

trust_option = click.option(
    "--trust", is_flag=True, help="Do not ask before running a template's Python code and opening its endpoints."
)


def shown(what: tuple[str, ...], between: str = ", ") -> str:
    """Return the first few names, and the number of the rest."""
    more = f"{between}and {len(what) - SHOWN} more" if len(what) > SHOWN else ""
    return escape(between.join(what[:SHOWN])) + more


def consent(*, trust: bool) -> Ask:
    """How consent is given: by the user at the terminal, or beforehand with --trust."""
    return lambda template: trust or ask_about(template)


def ask_about(template: ForeignParts) -> bool:
    """Print what a template contains and ask whether it may run. Without a terminal the answer is no."""
    if template.code:
        stderr.print(
            f"{escape(str(template.path))} contains control logic in Python: {shown(template.code)}.\n"
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
