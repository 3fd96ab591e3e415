"""`fieldtwin export`: convert recordings, or pack a prototype as an FMU."""

from __future__ import annotations

import click

from fieldtwin.cli.default_group import DefaultGroup
from fieldtwin.cli.recordings import export_command, export_fmu_command


@click.group("export", cls=DefaultGroup, default=export_command.command)
def command() -> None:
    """Convert a recording for other programs, or pack a prototype as an FMU for a simulation tool.

    \b
    fieldtwin export meter.jsonl meter.csv
    fieldtwin export fmu tank -o plc.fmu

    Arguments without the name of a command are those of `recording`: the first line is short for `fieldtwin export recording
    meter.jsonl meter.csv`.
    """


command.add_command(export_fmu_command.command)
