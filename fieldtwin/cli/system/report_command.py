"""`fieldtwin report`: collect dumps, differences, comparisons and checks in one document to print and sign."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import click

from fieldtwin.cli.options import json_option, pairs
from fieldtwin.console import stderr
from fieldtwin.gateway.core.errors import UsageError


@click.command("report")
@click.argument("files", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path), metavar="SITE...")
@click.option(
    "-o",
    "--out",
    default="site.html",
    show_default=True,
    type=click.Path(dir_okay=False, path_type=Path),
    help="The document, HTML.",
)
@click.option("--site", default="", help="Name of the site.  [default: the name of the folder]")
@click.option("--by", default="", help="Name of the person who carried it out.  [default: the name in the files]")
@click.option("--for", "customer", default="", help="Name of the operator, printed at the signature.")
@click.option("--remarks", default="", help="Additional remarks.")
@click.option(
    "--label", "labels", multiple=True, metavar="DEVICE=TEXT",
    help="The device's name on site; DEVICE is `unit 1`, or its number in the document. Repeatable.",
)  # fmt: skip
@click.option(
    "--serial",
    "serials",
    multiple=True,
    metavar="DEVICE=TEXT",
    help="The serial number on the device's name plate; repeatable.",
)
@json_option
def command(
    files: tuple[Path, ...],
    out: Path,
    site: str,
    by: str,
    customer: str,
    remarks: str,
    labels: tuple[str, ...],
    serials: tuple[str, ...],
    as_json: bool,
) -> int:
    """Make a site acceptance document from results: persons, dates, serial numbers, every deviation, and space for signatures.

    \b
    fieldtwin report site/ -o acceptance.html --serial "unit 1=A1234"
    fieldtwin report unit1.json unit1-dump.jsonl node5.json

    SITE is files, or folders of files: dumps, and the JSON of `check --out`, `diff` and `compare`. Print the document from a
    browser.
    """
    from fieldtwin.reports.site.html import NOTED, plural, write_html
    from fieldtwin.reports.site.reading import read_site
    from fieldtwin.results.subject import who

    folder = next((path for path in files if path.is_dir()), files[0].parent)
    document, left_out = read_site(
        files, site=site or folder.resolve().name, by=by, customer=customer, remarks=remarks,
        prepared=datetime.now(UTC).isoformat(timespec="seconds"),
    )  # fmt: skip
    if not by:
        named_ones = {source.by for source in document.sources if source.by}
        document = replace(document, by=named_ones.pop() if len(named_ones) == 1 else who())
    for text, what in [(text, "label") for text in labels] + [(text, "serial_said") for text in serials]:
        name, said = next(iter(pairs((text,), "device").items()))
        named = [d for d in document.devices if name in (str(d.number), d.name, f"{d.name} on {d.endpoint}")]
        if len(named) != 1:
            there = ", ".join(f"{d.number}: {d.name} on {d.endpoint}" for d in document.devices)
            raise UsageError(f"{len(named) or 'no'} device called {name!r}", expected=f"one of {there}")
        setattr(named[0], what, said)
    write_html(document, out)
    for why in left_out:
        stderr.print(f"left out: {why}", markup=False, soft_wrap=True)
    if as_json:
        json.dump(document.as_json(), sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        found = f"{plural(document.count('deviation'), 'deviation')}, {plural(document.count('open'), 'open point')}"
        for weight, name in NOTED.items():
            if count := document.count(weight):
                found += f", {plural(count, name)}"
        click.echo(f"{out}: {plural(len(document.devices), 'device')}, {found}")
    return 0
