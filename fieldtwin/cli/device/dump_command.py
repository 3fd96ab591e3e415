"""`fieldtwin dump`: record a device's values, its unreadable ranges, and the longest read that it accepts."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from fieldtwin.cli.device.device_options import DeviceOptions, log_option, words
from fieldtwin.cli.device.dump_view import estimate_text, notes, object_indexes, profile_gaps, summary, unknown_text
from fieldtwin.cli.option_groups import GroupedCommand, group, option
from fieldtwin.cli.options import Duration, json_option
from fieldtwin.commissioning.dump.dump import DEFAULT_BUDGET_S, DumpJob
from fieldtwin.commissioning.dump.dump import Progress as Report
from fieldtwin.commissioning.dump.file import Dump, load_dump
from fieldtwin.commissioning.dump.profile import dumped_tags
from fieldtwin.commissioning.dump.session import dump, estimate, frames, log_path, object_ranges, register_spans
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.errors import Unreachable, UsageError
from fieldtwin.gateway.wallclock import run as run_precise

MOST_FRAMES = 100
"""The largest number of frames that `--dry-run` prints as text."""


@dataclass(frozen=True)
class ReadingOptions:
    """The reads of a dump: ranges, repetitions and rate. `longest` None: as many values as the device accepts."""

    thorough: bool = option(
        "--thorough",
        is_flag=True,
        help="Read every address; by default only every eighth one, and round numbers, in unreadable ranges.",
    )
    budget_s: float = option(
        "--budget",
        type=Duration(),
        default=f"{DEFAULT_BUDGET_S / 60:g}m",
        show_default=True,
        help="Time for each table to search unreadable ranges: after silence, and with different read lengths.",
    )
    longest: int | None = option(
        "--longest", type=click.IntRange(1, 2000), help="Values per read; default: as many as the device accepts."
    )
    pairs: bool = option("--pairs", is_flag=True, help="The device supports only pairs of registers.")
    no_functions: bool = option(
        "--no-functions", is_flag=True, help="Do not test functions 07h, 08h, 0Bh, 0Ch, 11h, 2Bh."
    )
    passes: int = option(
        "--passes", type=click.IntRange(1, 100_000), default=1, show_default=True, help="Number of passes, for `infer`."
    )
    every_s: float = option(
        "--every", type=Duration(), default="10s", show_default=True, help="Time from pass to pass."
    )
    rate: float = option(
        "--rate",
        type=click.FloatRange(0, 1000),
        default=50,
        show_default=True,
        help="Maximum requests per second; 0: no limit.",
    )
    retries: int = option(
        "--retries", type=click.IntRange(0, 10), default=2, show_default=True, help="Repetitions without a valid reply."
    )


@click.command("dump", cls=GroupedCommand)
@click.argument("endpoint")
@click.argument("ranges", nargs=-1, metavar="[RANGE]...")
@group("Device", device=DeviceOptions)
@group("What is read", reading=ReadingOptions)
@group(
    "Output",
    click.option(
        "-o", "--out", type=click.Path(dir_okay=False, path_type=Path), help="The dump; default dump-ADDRESS.jsonl."
    ),
    click.option("--resume", is_flag=True, help="Continue the existing file."),
    click.option(
        "--dry-run",
        is_flag=True,
        help="Print the first 100 frames for a device that refuses nothing (all with --json); send nothing.",
    ),
    log_option,
    json_option,
)
def command(
    endpoint: str,
    ranges: tuple[str, ...],
    device: DeviceOptions,
    reading: ReadingOptions,
    out: Path | None,
    resume: bool,
    dry_run: bool,
    log: Path | None,
    as_json: bool,
) -> int:
    """Dump the device at ENDPOINT: values, unreadable ranges, longest read, latency, supported functions. It sends only reads.

    RANGEs are holding, holding:0..999 or 40001..40100, and 6000..6FFF on a CAN bus. The default is all tags of the profile or
    EDS, else everything. A log of all sent frames is written next to the dump.

    Exit code 4 if most of the ranges is still unknown at the end: no reply, no valid reply, or not asked.

    \b
    fieldtwin dump tcp://192.168.0.7 -o meter.jsonl
    fieldtwin dump 'rtu:/dev/ttyUSB0?baudrate=9600&frame=8N1' \\
        holding:0..999 --passes 20 --every 15s
    fieldtwin dump can:socketcan/can0 --node 5 --eds drive.eds
    """
    target = device.target(endpoint)
    if log is not None:
        raise UsageError("a dump always writes its log next to itself", got="--log")
    modbus = target.protocol == "modbus"
    spacing_s = 1 / reading.rate if reading.rate else 0.0
    job = DumpJob(
        target,
        spans=register_spans(ranges) if modbus else (),
        objects=() if modbus else object_ranges(ranges),
        stride=1 if reading.thorough else 8,
        most=reading.longest,
        pairs=reading.pairs or (target.profile is not None and target.profile.form.limits.even_only),
        passes=reading.passes,
        every_s=reading.every_s,
        functions=not reading.no_functions,
        budget_s=reading.budget_s,
        spacing_s=spacing_s,
    )
    if dry_run:
        _print_frames(frames(job), as_json=as_json)
        return 0
    out = out or Path(f"dump-{target.address}.jsonl")
    stderr.print(estimate_text(estimate(job, spacing_s), reading.passes, reading.rate), soft_wrap=True)
    _tell_what_is_left_out(job)
    try:
        with _bar(out.name) as progress:
            run_precise(
                dump(
                    job,
                    out,
                    words=words(),
                    resume=resume,
                    retries=reading.retries,
                    spacing_s=spacing_s,
                    progress=progress,
                )
            )
    except KeyboardInterrupt:
        stderr.print(f"stopped; the values read so far are in {out}, and --resume continues", soft_wrap=True)
        raise
    found = load_dump(out)
    if as_json:
        click.echo(json.dumps(_described(found, out)))
    else:
        for part in summary(found):
            stdout.print(part)
        stderr.print(f"{out}, and what was sent in {log_path(out)}", soft_wrap=True)
    if found.is_mostly_unknown:
        stderr.print(unknown_text(found), soft_wrap=True)
        return Unreachable.exit_code
    return 0


def _print_frames(all_frames: list[str], *, as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps({"frames": all_frames}))
        return
    for frame in all_frames[:MOST_FRAMES]:
        click.echo(frame)
    if len(all_frames) > MOST_FRAMES:
        stderr.print(
            f"{MOST_FRAMES} of {len(all_frames):,} frames; --dry-run --json prints all, and RANGE (such as holding:0..999) "
            "makes the dump shorter",
            soft_wrap=True,
        )


def _tell_what_is_left_out(job: DumpJob) -> None:
    if job.target.profile is not None and not job.spans and job.target.protocol == "modbus":
        left = [t.name for t in dumped_tags(job.target.profile)[1]]
        if left:
            stderr.print(f"left out, secret or changed by reading: {', '.join(left)}", soft_wrap=True)


def _described(found: Dump, out: Path) -> dict[str, Any]:
    return {
        "out": str(out),
        "log": str(log_path(out)),
        "passes": len(found.passes),
        "values": len(found.passes[-1].cells),
        "maps": [
            m | ({"indexes": object_indexes(found)} if m["map"] == "objects" else {}) for m in found.maps.values()
        ],
        "unknown": dict(zip(("addresses", "of"), found.unknown, strict=True)),
        "mostly_unknown": found.is_mostly_unknown,
        "functions": list(found.functions.values()),
        "latency": found.latency,
        "gaps": profile_gaps(found),
        "notes": notes(found),
    }


@contextmanager
def _bar(name: str) -> Iterator[Report]:
    """Yield the function that reports the progress; on a terminal it shows a progress bar, elsewhere nothing."""
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed} of {task.total}, {task.fields[requests]} requests"),
        TimeRemainingColumn(),
        console=stderr,
        transient=True,
        disable=not stderr.is_terminal,
    ) as bar:
        task = bar.add_task(name, total=None, requests=0)
        yield lambda done, total, requests: bar.update(task, completed=done, total=total, requests=requests)
