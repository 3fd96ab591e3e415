"""`fieldtwin explain`: explain an ID, a code or a word of a message."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from itertools import groupby

import click
from rich.padding import Padding

from fieldtwin.book import base_url
from fieldtwin.cli.completions import explained
from fieldtwin.cli.options import json_option
from fieldtwin.console import stdout


@click.command("explain")
@click.argument("words", nargs=-1, shell_complete=explained)
@json_option
def command(words: tuple[str, ...], as_json: bool) -> int:
    """Explain what WORDS mean, where they are defined, and what to do: a test case (MB-015), a fault (late-reply), a Modbus
    exception (exception 02), an SDO abort code (06020000), a quality or its reason (stale), a verdict (inconclusive), a certainty
    (likely), an error (CrcError), an exit code (exit 4). Without WORDS, list all.

    Words of a message can be copied as they are printed.
    """
    from fieldtwin.explain.lookup import everything, explain

    found = explain(" ".join(words)) if words else everything()
    if as_json:
        json.dump([asdict(entry) for entry in found], sys.stdout, indent=2)
        sys.stdout.write("\n")
        return 0
    if not words:
        for kind, entries in groupby(found, key=lambda entry: entry.kind):
            stdout.print(f"[bold]{kind}[/bold]", highlight=False)
            for entry in entries:
                stdout.print(f"  {entry.id:<20} {entry.title}", markup=False, highlight=False)
        return 0
    for number, entry in enumerate(found):
        if number:
            stdout.print()
        stdout.print(f"[bold]{entry.id}[/bold]  {entry.kind}: {entry.title}", highlight=False)
        stdout.print(Padding(entry.meaning, (0, 0, 0, 2), expand=False), highlight=False, markup=False)
        stdout.print(Padding(f"What to do: {entry.todo}", (0, 0, 0, 2), expand=False), highlight=False, markup=False)
        if entry.page:
            where = f"{base_url()}/{entry.page}" if base_url() else f"{entry.page} (built by scripts/docs)"
            stdout.print(Padding(f"Page: {where}", (0, 0, 0, 2), expand=False), highlight=False, markup=False)
        if entry.source:
            stdout.print(Padding(f"Source: {entry.source}", (0, 0, 0, 2), expand=False), highlight=False, markup=False)
    return 0
