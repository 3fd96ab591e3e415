"""`fieldtwin plc trace`: record variables of programs after each scan, in a running instance or in virtual time."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import Duration, json_option
from fieldtwin.cli.output_files import write_text
from fieldtwin.cli.template_question import TemplateSearchOptions
from fieldtwin.console import stderr
from fieldtwin.gateway.core.errors import UsageError

if TYPE_CHECKING:
    from fieldtwin.plc.runtime.variable_trace import TraceSize
    from fieldtwin.results.scan_trace import ScanTrace

DEFAULT_SCANS = 1000
SUFFIXES = (".csv", ".svg", ".html", ".json")


@click.command("trace", cls=GroupedCommand)
@click.argument("variables", nargs=-1, required=True)
@group(
    "Ring and trigger",
    click.option(
        "--scans",
        type=click.IntRange(1),
        default=DEFAULT_SCANS,
        show_default=True,
        help="Scans that are kept; with --when, those from the trigger on.",
    ),
    click.option(
        "--when",
        default="",
        metavar="CONDITION",
        help="Trigger: a condition in Structured Text in the program of the first variable, such as 'level > 80.0'.",
    ),
    click.option("--before", type=click.IntRange(0), default=100, show_default=True, help="Scans before the trigger."),
    click.option(
        "--for",
        "duration_s",
        type=Duration(),
        default=None,
        help="End after this time; in virtual time 1min by default.",
    ),
)
@group(
    "Virtual time",
    click.option(
        "--system", default="", metavar="SYSTEM", help="Run this system in virtual time instead of an instance."
    ),
    click.option("--seed", type=int, default=None, help="The seed of that run."),
)
@group("Profiles and templates", sources=TemplateSearchOptions)
@group(
    "Output",
    click.option(
        "-o",
        "--output",
        type=click.Path(dir_okay=False, path_type=Path),
        default=None,
        help="File of the result; its suffix selects the format: .csv, .svg, .html or .json.",
    ),
    json_option,
)
@click.option("--instance", default="", metavar="NAME", help="Name of the instance; default: the only running one.")
def trace(
    variables: tuple[str, ...],
    scans: int,
    when: str,
    before: int,
    duration_s: float | None,
    system: str,
    seed: int | None,
    sources: TemplateSearchOptions,
    output: Path | None,
    as_json: bool,
    instance: str,
) -> int:
    """Record VARIABLES after each scan, and show them as trends. Ctrl-C ends the recording.

    \b
    fieldtwin plc trace pump.state pump.timer.ET --for 10s -o pump.html
    fieldtwin plc trace pump.level --when 'level > 80.0' --before 50 --scans 200
    fieldtwin plc trace pump.level --system plant.yaml --for 10min -o level.csv

    VARIABLES are named as in `fieldtwin plc watch`: tags, and variables of programs with members and elements. Without
    --when, the last --scans are kept; without --for, a recording ends after --scans. Without a terminal and without -o,
    the result is CSV on stdout.
    """
    from fieldtwin.cli.plc.trace_view import print_trace
    from fieldtwin.plc.runtime.variable_trace import TraceSize

    if output is not None and output.suffix.lower() not in SUFFIXES:
        raise UsageError("the format of the result", expected=", ".join(SUFFIXES), got=output.suffix or output.name)
    size = TraceSize(before, scans) if when else TraceSize(scans)
    if system:
        found = _in_virtual_time(variables, size, when, system, duration_s, seed, sources)
    else:
        from fieldtwin.cli.plc.live_trace import LiveTrace
        from fieldtwin.run.processes.plc_client import choose

        found = asyncio.run(LiveTrace(variables, size, when, duration_s).run(choose(instance)))
    if found.lost:
        stderr.print(f"{found.lost} scans were lost, because they were not read in time", style="yellow")
    if when and found.triggered is None:
        stderr.print(f"the condition was never TRUE: {when}", style="yellow", markup=False)
    if output is not None:
        write_text(output, _text(found, output.suffix.lower(), when))
        stderr.print(f"{output}: {len(found.rows)} scans", markup=False, soft_wrap=True)
    if as_json:
        json.dump(found.as_data(), sys.stdout)
        sys.stdout.write("\n")
    elif sys.stdout.isatty():
        print_trace(found)
    elif output is None:
        sys.stdout.write(found.csv())
    return 0


def _text(found: ScanTrace, suffix: str, when: str) -> str:
    """Return the content of the file for a suffix."""
    if suffix == ".csv":
        return found.csv()
    if suffix == ".json":
        return json.dumps(found.as_data())
    from fieldtwin.reports.run.scan_trace import trace_page, trace_svg

    title = f"Trace triggered by {when}" if when else "Trace of variables"
    return str(trace_page(found, title) if suffix == ".html" else trace_svg(found, title))


def _in_virtual_time(
    variables: tuple[str, ...],
    size: TraceSize,
    when: str,
    system: str,
    duration_s: float | None,
    seed: int | None,
    sources: TemplateSearchOptions,
) -> ScanTrace:
    from fieldtwin.results.scan_trace import ScanTrace, TraceColumn
    from fieldtwin.run.template import system_file
    from fieldtwin.run.virtual.run import VirtualOptions
    from fieldtwin.run.virtual.variable_trace import TracedRun

    file = system_file(system, sources.ask(), virtual=True, profiles=sources.profiles)
    options = VirtualOptions(file, 60.0 if duration_s is None else duration_s, seed, sources.profiles)
    run = TracedRun(options, variables, size, when)
    run.run()
    for error in run.errors:
        stderr.print(error, style="red", markup=False, soft_wrap=True)
    recorded = run.recorded
    if recorded is None:
        raise UsageError("the system did not start", where=system)
    columns = [TraceColumn(v.name, v.type, v.unit) for v in recorded.variables]
    found = ScanTrace(columns, size.before + size.after, recorded.triggered_row)
    for row in recorded.rows:
        found.add(row)
    found.lost = 0
    return found
