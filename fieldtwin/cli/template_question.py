"""The question before what a template brings is run. A plant asks it too: nothing here knows emulators."""

from __future__ import annotations

import sys

import click
from rich.markup import escape

from fieldtwin.cli.talk import talk
from twin.template_package import Package

SHOWN_CODE = 5


def ask_about_code(package: Package) -> bool:
    """Say what Python a template brings and ask whether it may run. Without a terminal the answer is no."""
    code = package.code
    more = f", and {len(code) - SHOWN_CODE} more" if len(code) > SHOWN_CODE else ""
    talk.print(
        f"{escape(str(package.path))} brings control logic in Python: {escape(', '.join(code[:SHOWN_CODE]))}{more}.\n"
        "It is a program: run, it can do on this computer whatever you can.",
        soft_wrap=True,
    )
    if not sys.stdin.isatty():
        return False
    return click.confirm("Run it?", default=False, err=True)
