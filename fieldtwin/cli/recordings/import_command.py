"""`fieldtwin import`: convert files of other programs to recordings."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import click
from rich.progress import BarColumn, DownloadColumn, Progress, TimeRemainingColumn

from fieldtwin.capture.formats.cnv import import_cnv
from fieldtwin.cli.options import json_option, pairs
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.errors import UsageError

_SUFFIXES = (
    ".gz",
    ".bz2",
    ".cnv",
    ".pcap",
    ".pcapng",
    ".cap",
    ".log",
    ".asc",
    ".blf",
    ".trc",
    ".csv",
    ".tsv",
    ".txt",
    ".jsonl",
)


@click.command("import")
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    help="The recording; default: FILE's name with .jsonl (of CAN: .log), here.",
)
@click.option(
    "--column",
    "columns",
    multiple=True,
    metavar="SIGNAL=COLUMN",
    help="CSV, .cnv: take a signal from a column, e.g. temperature=t190C or level=#3.",
)
@click.option("--time", default="", metavar="COLUMN", help="CSV: the time column; default: by its name.")
@click.option("--device", default="", metavar="MAKER/TYPE", help="CSV: name of the device.")
@click.option(
    "--port", "ports", type=click.IntRange(1, 65_535), multiple=True, help="pcap: only this TCP port carries Modbus."
)
@click.option(
    "--endpoint", default="", metavar="URL", help="Endpoint to import from a fieldtwin capture with several endpoints."
)
@click.option("--framing", type=click.Choice(["rtu", "ascii", "mbap"]), default=None, help="Protocol of a capture.")
@json_option
def command(
    file: Path,
    out: Path | None,
    columns: tuple[str, ...],
    time: str,
    device: str,
    ports: tuple[int, ...],
    endpoint: str,
    framing: str | None,
    as_json: bool,
) -> int:
    """Convert FILE to a recording, and network traffic also to draft profiles.

    \b
    site.pcapng         Modbus TCP on any port, RTU over TCP, UDP, and CAN
                        (SocketCAN): a recording for each server
    bus.log .asc .blf .trc
                        CAN traffic: a log that `emulate` replays
    table.csv           a time column and signals (--time, --column)
    cast.cnv(.gz .bz2)  a Sea-Bird cast: signals of the `ctd`
    poll.txt            output of mbpoll or modpoll
    capture.jsonl       a capture of `run --capture` or `record --tap`
    """
    from fieldtwin.capture.recordings.importing import import_can, import_capture, import_polls, kind_of

    kind = kind_of(file)
    if kind != "csv" and (time or device):
        raise UsageError("--time and --device need a CSV file")
    if kind not in ("csv", "cnv") and columns:
        raise UsageError("--column needs a CSV or .cnv file")
    out = out or Path(_stem(file) + (".log" if kind == "can" else ".jsonl"))
    if out.exists() and out.samefile(file):
        raise UsageError(f"{file.name} would be its own recording", hint="--out NAME")
    match kind:
        case "packets":
            return _packets(file, out, ports, as_json)
        case "can":
            return _show_text(import_can(file, out), "frames", as_json)
        case "polls":
            return _show_text(import_polls(file, out), "exchanges", as_json)
        case "capture":
            return _show_text(import_capture(file, out, framing or "", endpoint), "records", as_json)
    if kind == "csv":
        from fieldtwin.capture.formats.csv_table import import_csv

        made_by = f"fieldtwin import {file.name}"
        table = import_csv(file, out, columns=pairs(columns, "--column"), time=time, device=device, made_by=made_by)
        return _show_signals(out, table, table.rows, table.seconds, table.columns, table.bad_values, as_json)
    with _bar(file) as progress:
        cast = import_cnv(file, out, progress=progress, columns=pairs(columns, "--column"))
    return _show_signals(out, cast, cast.rows, cast.seconds, cast.columns, cast.bad_values, as_json)


def _stem(file: Path) -> str:
    name = file.name
    while Path(name).suffix.lower() in _SUFFIXES:
        name = Path(name).stem
    return name


class _bar:
    """A progress bar, shown on a terminal only."""

    def __init__(self, file: Path) -> None:
        self._bar = Progress(
            "[progress.description]{task.description}", BarColumn(), DownloadColumn(), TimeRemainingColumn(),
            console=stderr, transient=True, disable=not stderr.is_terminal,
        )  # fmt: skip
        self._task = self._bar.add_task(file.name, total=None)

    def __enter__(self) -> Callable[[int, int], None]:
        self._bar.start()
        return lambda done, total: self._bar.update(self._task, completed=done, total=total)

    def __exit__(self, *_: object) -> None:
        self._bar.stop()


def _packets(file: Path, out: Path, ports: tuple[int, ...], as_json: bool) -> int:
    from fieldtwin.capture.recordings.from_packets import PacketImport

    with _bar(file) as progress:
        found = PacketImport(file, out, ports).run(progress)
    if as_json:
        return _print_json(found)
    for made in found.made:
        if made.endpoint == "can":
            stdout.print(f"{made.path}: {made.exchanges} CAN frames", soft_wrap=True)
            continue
        units = ", ".join(map(str, made.units)) or "no unit answered"
        where = f" of {made.endpoint}" if made.endpoint else ""
        stdout.print(f"{made.path}: {made.exchanges} exchanges{where}, units {units}", soft_wrap=True)
        for profile in made.profiles:
            stdout.print(f"  draft profile: {profile}", soft_wrap=True)
    packets, pairs_ = found.packets, found.pairs
    stderr.print(f"{packets.packets} packets in {found.seconds:.1f} s, {packets.carried} with payload", soft_wrap=True)
    notes = [
        (pairs_.unanswered, "requests without an answer"), (pairs_.strays, "answers without a request"),
        (pairs_.malformed, "malformed"), (packets.lost_bytes, "bytes that the capture lost"),
        (packets.fragments, "IP packets of which a piece is missing"), (packets.cut_short, "packets cut short"),
        (found.can_left_out, "CAN frames left out (CAN FD, or cut short)"),
        (found.other_conversations, "conversations that are not Modbus"),
        (found.servers_left_out, "exchanges of further servers, left out"),
    ]  # fmt: skip
    for count, what in notes:
        if count:
            stderr.print(f"  {count} {what}", soft_wrap=True)
    if found.cut_off_at is not None:
        stderr.print(f"  the file is cut off in its last packet, at offset {found.cut_off_at}", soft_wrap=True)
    if found.bad_file is not None:
        stderr.print(f"  malformed or unmatched frames: {found.bad_file}", soft_wrap=True)
    if not found.made:
        stderr.print("it contains neither Modbus nor CAN", soft_wrap=True)
    return 0


def _show_text(found: Any, what: str, as_json: bool) -> int:
    if as_json:
        return _print_json(found)
    stdout.print(f"{found.out}: {found.records} {what}, {found.seconds:.1f} s", soft_wrap=True)
    for profile in found.profiles:
        stdout.print(f"  draft profile: {profile}", soft_wrap=True)
    notes = [
        (found.left_out.fd, "CAN FD frames left out"), (found.left_out.errors, "error frames left out"),
        (found.pairs.unanswered, "requests without an answer"), (found.pairs.strays, "answers without a request"),
        (found.pairs.malformed, "malformed"),
    ]  # fmt: skip
    for count, text in notes:
        if count:
            stderr.print(f"  {count} {text}", soft_wrap=True)
    if found.bad_file is not None:
        stderr.print(f"  malformed or unmatched frames: {found.bad_file}", soft_wrap=True)
    return 0


def _show_signals(
    out: Path, found: Any, rows: int, seconds: float, columns: dict[str, str], bad_values: int, as_json: bool
) -> int:
    if as_json:
        json.dump({"out": str(out), **asdict(found)}, sys.stdout, default=str)
        sys.stdout.write("\n")
        return 0
    stdout.print(f"{out}: {rows} rows, {seconds:.1f} s", soft_wrap=True)
    for signal, column in columns.items():
        stdout.print(f"  {signal}: column {column}", soft_wrap=True)
    if bad_values:
        stdout.print(f"  {bad_values} values are marked bad in the file and stay without a value", soft_wrap=True)
    return 0


def _print_json(found: Any) -> int:
    assert is_dataclass(found)
    assert not isinstance(found, type)
    json.dump(asdict(found), sys.stdout, default=str)
    sys.stdout.write("\n")
    return 0
