"""`fieldtwin infer`: infer the register types from dumps, and write a draft profile."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import click
from rich.table import Table
from rich.text import Text

from fieldtwin.capture.recordings.rotating_file import exchanges_of, header_of
from fieldtwin.cli.options import json_option
from fieldtwin.cli.output_files import write_text
from fieldtwin.commissioning.dump.file import Dump, load_dump
from fieldtwin.commissioning.infer.draft import checked, doubts, draft_profile
from fieldtwin.commissioning.infer.fields import FEWEST_PASSES, Interpretation, Level
from fieldtwin.commissioning.infer.infer import Inference, infer, series_of
from fieldtwin.commissioning.infer.recorded_passes import dump_of_recording
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.input_file import reading

MOST_HEADER_BYTES = 65_536
COLOUR = {Level.CERTAIN: "green", Level.LIKELY: "", Level.GUESS: "yellow", Level.UNKNOWN: "red"}


@click.command("infer")
@click.argument("dumps", nargs=-1, required=True, type=click.Path(dir_okay=False, path_type=Path), metavar="DUMP...")
@click.option("-o", "--out", type=click.Path(dir_okay=False, path_type=Path), help="Write a draft profile here.")
@click.option("--name", default="", help="The draft's name; default: the unit.")
@click.option("--unit", type=click.IntRange(0, 255), help="The unit of a recording with several units.")
@click.option("--all", "everything", is_flag=True, help="Also show registers that were always 0.")
@json_option
def command(
    dumps: tuple[Path, ...], out: Path | None, name: str, unit: int | None, everything: bool, as_json: bool
) -> int:
    """Infer types, byte orders, scales, counters, states and times of registers from DUMPs of one unit, taken over time.

    A DUMP may also be a recording of `fieldtwin record` (also with --sniff or --tap) or of `fieldtwin import`. More passes,
    and larger changes of the values between them, give more certain results: `fieldtwin dump --passes 20 --every 15s`.

    \b
    fieldtwin infer meter.jsonl -o meter.yaml
    fieldtwin emulate ./meter.yaml --on tcp://127.0.0.1:1502
    """
    if out is not None and out.exists():
        raise FileInvalid(
            "the file already exists",
            path=str(out),
            hint="choose another name, or remove the file: the draft replaces no file",
        )
    loaded = [_load(path, unit) for path in dumps]
    inference = infer(series_of(loaded))
    if inference.series.passes < FEWEST_PASSES:
        passes = "1 pass" if inference.series.passes == 1 else f"{inference.series.passes} passes"
        stderr.print(
            f"{passes}: results are uncertain below {FEWEST_PASSES}; use `dump --passes 20`",
            soft_wrap=True,
        )
    draft = draft_profile(inference, loaded, name)
    checked(draft, out or Path("draft.yaml"))
    if out is not None:
        write_text(out, draft)
    if as_json:
        click.echo(json.dumps(_described(inference, out)))
        return 0
    stdout.print(_table([r for r in inference.readings if everything or any(r.values)]))
    idle = sum(r.registers for r in inference.readings if not any(r.values))
    if idle and not everything:
        stderr.print(f"{idle} registers were always 0 and are not shown (--all); the draft has them")
    if out is not None:
        stderr.print(f"draft: {out}", soft_wrap=True)
    return 0


def _load(path: Path, unit: int | None) -> Dump:
    """Load a dump, or a recording of exchanges as a dump. Raises `FileInvalid`, `UsageError`."""
    with reading(path), path.open("rb") as file:
        is_recording = b'"fieldtwin_recording"' in file.readline(MOST_HEADER_BYTES)
    if not is_recording:
        return load_dump(path)
    header = header_of(path)
    if header.kind != "exchanges":
        raise FileInvalid(f"a recording of {header.kind}", path=str(path), expected="a recording of exchanges")
    return dump_of_recording(str(path), header, exchanges_of(path), unit)


def _table(readings: list[Interpretation]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("at", "type", "last", "how sure, and why"):
        table.add_column(name, overflow="fold")
    for r in readings:
        kind = "unknown" if r.level is Level.UNKNOWN else r.type
        kind += (
            ""
            if r.level is Level.UNKNOWN
            else (f"[{r.registers}]" if r.type == "string" else f" {r.order}" if r.registers > 1 else "")
        )
        kind += " swapped" if r.registers == 1 and r.order == "BADC" else ""
        kind += f" x {r.scale:g}" if r.scale != 1.0 else ""
        value = r.values[-1]
        last = repr(value) if isinstance(value, str) else "NaN" if math.isnan(value) else f"{value * r.scale:.7g}"
        table.add_row(f"{r.table}:{r.address}", kind, Text(last), Text(doubts(r), COLOUR[r.level]))
    return table


def _described(inference: Inference, out: Path | None) -> dict[str, Any]:
    rows = [
        {
            "at": f"{r.table}:{r.address}",
            "type": r.type,
            "order": r.order,
            "registers": r.registers,
            "scale": r.scale,
            "level": str(r.level),
            "probability": round(r.probability, 5),
            "sign_open": r.sign_open,
            "capped": r.capped,
            "marks": list(r.marks),
            "notes": list(r.notes),
            "rivals": [
                dict(zip(("type", "address", "order", "probability"), rival, strict=True)) for rival in r.rivals
            ],
            "sentinels": list(r.sentinels),
            "last": _last(r),
        }
        for r in inference.readings
    ]
    return {"passes": inference.series.passes, "readings": rows, "draft": str(out) if out is not None else None}


def _last(reading: Interpretation) -> float | str | None:
    """Return the last value; None for NaN, which JSON does not have."""
    value = reading.values[-1]
    return value if isinstance(value, str) or not math.isnan(value) else None
