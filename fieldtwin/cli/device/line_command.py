"""`fieldtwin line`: examine a serial line or bus without sending."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
from rich.table import Table
from rich.text import Text

from fieldtwin.cli.device.device_options import log_option, logged
from fieldtwin.cli.device.scan_progress import ScanProgress
from fieldtwin.cli.options import Duration, json_option
from fieldtwin.cli.stop_key import StopKey
from fieldtwin.commissioning.scan.line import LineCheckOptions, LineReport, look_at_line
from fieldtwin.console import stdout
from fieldtwin.gateway.wallclock import run as run_precise


@click.command("line")
@click.argument("endpoint")
@click.option("--listen", "listen_s", type=Duration(), default="5s", show_default=True, help="How long to listen.")
@click.option(
    "--probe",
    "probe_unit",
    type=click.IntRange(1, 247),
    metavar="UNIT",
    help="Serial: send one read to UNIT, to detect an echo and an answer.",
)
@click.option("--share-bus", is_flag=True, help="Send the probe although the line carries traffic.")
@click.option(
    "--timeout",
    "timeout_s",
    type=Duration(),
    default="500ms",
    show_default=True,
    help="Timeout for the probe's answer.",
)
@click.option("--bitrate", type=click.IntRange(10_000, 1_000_000), help="CAN: expected bit rate of the bus, in bit/s.")
@log_option
@json_option
def command(endpoint: str, log: Path | None, as_json: bool, **options: Any) -> int:  # fmt: skip
    """Examine the serial line or bus at ENDPOINT without sending: traffic, the port's error counters, and possible faults, the
    most likely first.

    Settings that ENDPOINT leaves open are found from the traffic, if there is any. Exit code 1: there is a sign of a fault.
    """
    report = run_precise(_look(endpoint, log, LineCheckOptions(**options | {"bitrate": options["bitrate"] or 0})))
    if as_json:
        click.echo(json.dumps(_json(report)))
    else:
        _show(report)
    return 0 if report.healthy else 1


async def _look(endpoint: str, log: Path | None, look: LineCheckOptions) -> LineReport:
    with logged(log) as taps, StopKey() as stop, ScanProgress(stop.listens) as show:
        return await look_at_line(endpoint, look, on_progress=show, stop=stop.pressed, taps=taps)


def _show(report: LineReport) -> None:
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, text in report.facts:
        table.add_row(name, Text(text))
    stdout.print(table)
    if not report.causes:
        stdout.print(Text("no sign of a fault", "green"))
        return
    stdout.print()
    causes = Table(box=None, pad_edge=False, header_style="bold", title="possible causes, the most likely first",
                   title_justify="left", title_style="bold")  # fmt: skip
    for name in ("cause", "because", "try"):
        causes.add_column(name, overflow="fold")
    for cause in report.causes:
        causes.add_row(Text(cause.name, "yellow" if cause.weight >= 50 else "dim"), Text(cause.why), Text(cause.remedy))
    stdout.print(causes)


def _json(report: LineReport) -> dict[str, Any]:
    heard = report.heard
    return {
        "endpoint": report.url,
        "kind": report.kind,
        "facts": dict(report.facts),
        "causes": [asdict(c) for c in report.causes],
        "healthy": report.healthy,
        "sent": report.sent,
        "heard": {"bytes": heard.bytes, "frames": heard.frames, "live": heard.live} if heard is not None else None,
        "errors": asdict(report.errors) if report.errors is not None else None,
        "probe": asdict(report.probe) if report.probe is not None else None,
    }
