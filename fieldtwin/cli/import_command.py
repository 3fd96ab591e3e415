"""`fieldtwin import`: foreign files become recordings."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path

import click
from rich.progress import BarColumn, DownloadColumn, Progress, TimeRemainingColumn

from fieldtwin.cli.options import json_option, pairs
from fieldtwin.cli.talk import data, talk
from fieldtwin.formats.cnv import import_cnv
from gateway.core.errors import UsageError

CNV = (".cnv", ".cnv.gz", ".cnv.bz2")


@click.command("import")
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    help="The recording; default: FILE's name with .jsonl, here.",
)
@click.option(
    "--column",
    "columns",
    multiple=True,
    metavar="SIGNAL=COLUMN",
    help="Take a signal from another column, e.g. temperature=t190C.",
)
@json_option
def command(file: Path, out: Path | None, columns: tuple[str, ...], as_json: bool) -> int:
    """Turn FILE into a recording: a Sea-Bird cast (.cnv, .cnv.gz, .cnv.bz2) becomes one of the `ctd`.

    Serve it with `fieldtwin run observatory --prototype --recording ctd=OUT`.
    """
    suffix = next((s for s in CNV if file.name.lower().endswith(s)), None)
    if suffix is None:
        raise UsageError(f"cannot import {file.name!r}", expected=", ".join(CNV))
    out = out or Path(file.name[: -len(suffix)] + ".jsonl")
    with Progress(
        "[progress.description]{task.description}",
        BarColumn(),
        DownloadColumn(),
        TimeRemainingColumn(),
        console=talk,
        transient=True,
        disable=not talk.is_terminal,
    ) as bar:
        task = bar.add_task(file.name, total=None)
        summary = import_cnv(
            file,
            out,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
            columns=pairs(columns, "--column"),
        )
    if as_json:
        json.dump({"out": str(out), **asdict(summary)}, sys.stdout, default=str)
        sys.stdout.write("\n")
        return 0
    data.print(f"{out}: {summary.rows} rows, {summary.seconds:.1f} s", soft_wrap=True)
    for signal, column in summary.columns.items():
        data.print(f"  {signal}: column {column}")
    if summary.bad_values:
        data.print(f"  {summary.bad_values} values are marked bad in the file and stay without a value")
    return 0
