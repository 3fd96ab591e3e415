"""A dump from end to end: the ranges of the user, the estimated duration, the files, and the connection.

This module must not depend on a display.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.commissioning.access.address import raw_tag
from fieldtwin.commissioning.access.connection import canopen_at, frame_of, modbus_at
from fieldtwin.commissioning.access.frame_log import FrameLog
from fieldtwin.commissioning.access.point import CanopenPoint
from fieldtwin.commissioning.dump.asking import CanopenAsker, DeviceReader, ModbusAsker
from fieldtwin.commissioning.dump.dump import Dumper, DumpJob, DumpResult, Progress, check_resumable, started
from fieldtwin.commissioning.dump.file import TABLES, Dump, DumpWriter, load_dump
from fieldtwin.commissioning.dump.objects import ListedObjects, ObjectSweep
from fieldtwin.commissioning.dump.profile import ProfileSweep
from fieldtwin.commissioning.dump.sweep import ROUND, Sweep
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.connection import Connector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.profile import RegisterRange, resolve_gap
from fieldtwin.gateway.devices.read_plan import read_request
from fieldtwin.gateway.wallclock import WallClock

REPLY_S = 0.01
"""Assumed response time of a device in seconds, for an estimate."""
_INDEXES = re.compile(r"^(?:0x)?([0-9A-Fa-f]{4})h?(?:\.\.(?:0x)?([0-9A-Fa-f]{4})h?)?$")
CAN_BITS = 2 * 130
"""Number of bits of an SDO request and its reply on the bus, with stuff bits."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """The number of requests and the duration in seconds of the first pass, if everything can be read and if nearly nothing can
    be read.

    `budgets_s` is the additional time that requests without a result may take, in all tables together. `shorter` names the
    options with which the user can make the dump shorter.
    """

    least_requests: int
    most_requests: int
    least_s: float
    most_s: float
    budgets_s: float
    shorter: str


def register_spans(texts: Sequence[str]) -> tuple[RegisterRange, ...]:
    """Return the ranges of texts such as ``holding``, ``holding:0..999``, ``40001..40100``. Raises `UsageError`."""
    spans = []
    for text in texts:
        table = next((t for t in TABLES if t == text), None)
        try:
            spans.append(RegisterRange(table, 0, 65536) if table is not None else resolve_gap(text, "printed"))
        except ValueError as e:
            raise UsageError(str(e), expected="holding, holding:0..999 or 40001..40100") from e
    return tuple(spans)


def object_ranges(texts: Sequence[str]) -> tuple[tuple[int, int], ...]:
    """Return the ranges of indices (both ends included) of texts such as ``6000..6FFF``, ``1018h``. Raises `UsageError`."""
    ranges = []
    for text in texts:
        match = _INDEXES.match(text)
        first = int(match[1], 16) if match else 0
        last = int(match[2] or match[1], 16) if match else -1
        if last < first:
            raise UsageError("no range of object indexes", expected="6000..6FFF or 1018", got=text)
        ranges.append((first, last))
    return tuple(ranges)


def estimate(job: DumpJob, spacing_s: float) -> Estimate:
    """Return the estimated number of requests and duration of a pass, with a pause of `spacing_s` seconds after each request."""
    least = most = 0
    for sweep in job.sweeps():
        if isinstance(sweep, Sweep):
            count = sweep.span.count
            longest = job.most or (2000 if sweep.span.table in ("coil", "discrete") else 125)
            least += -(-count // longest)
            most += count if sweep.stride == 1 else count // sweep.stride + count // ROUND
        elif isinstance(sweep, ProfileSweep):
            least += len(sweep.plan.reads)
            most += sum(2 * len(r.tags) for r in sweep.plan.reads)
        elif isinstance(sweep, ObjectSweep):
            count = sum(last - first + 1 for first, last in sweep.ranges)
            least, most = least + count, most + count
        elif isinstance(sweep, ListedObjects):
            least, most = least + len(sweep.keys), most + len(sweep.keys)
    most = max(least, most)
    endpoint = Endpoint.parse(job.target.url)
    char_s = endpoint.serial.char_time_s if endpoint.is_serial else 0.0
    if endpoint.is_can:
        long_s = short_s = CAN_BITS / (job.target.bitrate or 125_000)
    else:
        long_s, short_s = (8 + 7 + 255) * char_s, (8 + 7 + 7) * char_s
    each = spacing_s + REPLY_S
    budgets_s = job.budget_s * len(job.sweeps())
    if job.spans or job.objects:
        shorter = "fewer ranges"
    elif endpoint.is_can:
        shorter = "ranges, such as 6000..6FFF, with --eds"
    else:
        shorter = "ranges, such as holding:0..999, with --profile"
    shortest_s, longest_s = sorted((least * (each + long_s), most * (each + short_s)))
    return Estimate(least, most, shortest_s, longest_s, budgets_s, shorter)


def frames(job: DumpJob) -> list[str]:
    """Return the frames that would be sent if everything could be read."""
    target = job.target
    shown: list[str] = []
    node = CanopenPoint(None, target.url, target.address)
    for sweep in job.sweeps():
        if isinstance(sweep, Sweep):
            span, bits = sweep.span, sweep.span.table in ("coil", "discrete")
            longest = job.most or (2000 if bits else 124 if job.pairs else 125)
            spans = [
                RegisterRange(span.table, a, min(longest, span.end - a)) for a in range(span.address, span.end, longest)
            ]
            shown += [frame_of(target.url, target.address, read_request(r)).hex(" ") for r in spans]
        elif isinstance(sweep, ProfileSweep):
            shown += [frame_of(target.url, target.address, read_request(r)).hex(" ") for r in sweep.reads()]
        else:
            keys = (
                [(k.index, k.subindex) for k in sweep.keys]
                if isinstance(sweep, ListedObjects)
                else [(i, 0) for first, last in sweep.ranges for i in range(first, last + 1)]
            )
            shown += node.read_frames([raw_tag("", "auto", object_=key) for key in keys])
    return shown


def log_path(out: Path) -> Path:
    """Return the path of the log of all sent frames of the dump `out`, in the same folder."""
    return out.with_name(out.name.removesuffix(".jsonl") + ".sent.jsonl")


async def dump(
    job: DumpJob,
    out: Path,
    *,
    words: str,
    resume: bool = False,
    retries: int = 2,
    spacing_s: float = 0.0,
    progress: Progress = lambda done, total, requests: None,
    connector: Connector | None = None,
    clock: Clock | None = None,
) -> DumpResult:
    """Dump to the file `out`, which must not exist unless `resume`. Raises the errors of `Dumper.run`, and `FileInvalid`.

    For a file that is complete, `resume` only makes further passes. `words` is the command line, for the log of sent frames.
    """
    clock = clock or WallClock()
    if job.target.address == 0 and Endpoint.parse(job.target.url).scheme in ("rtu", "ascii", "rtu+tcp"):
        raise UsageError("unit 0 of a line is a broadcast: no unit answers", expected="--unit from 1 on")
    if out.exists() and not resume:
        raise FileInvalid("the file already exists", path=str(out), hint="--resume goes on with it")
    earlier = load_dump(out, keep_lines=True) if resume and out.exists() and out.stat().st_size else None
    if earlier is not None:
        check_resumable(job, earlier)
    target = job.target
    timing = target.profile.form.timing if target.profile is not None else None
    timeout_s = max(target.timeout_s, (timing.timeout_ms or 0) / 1000 if timing is not None else 0.0)
    spacing_s = max(spacing_s, timing.spacing_ms / 1000 if timing is not None else 0.0)
    with FrameLog(log_path(out), words, clock) as log:
        if target.protocol == "canopen":
            async with canopen_at(
                target.url, target.bitrate, sdo_timeout_s=timeout_s, taps=[log], connector=connector, clock=clock
            ) as master:
                node = CanopenAsker(master, target.address, clock, retries=retries, spacing_s=spacing_s)
                return await _run(job, node, clock, out, earlier, log, progress)
        async with modbus_at(
            target.url, timeout_s=timeout_s, echo=target.echo, taps=[log], connector=connector, clock=clock
        ) as client:
            unit = ModbusAsker(client, target.address, clock, retries=retries, spacing_s=spacing_s)
            return await _run(job, unit, clock, out, earlier, log, progress)


async def _run(
    job: DumpJob, asker: DeviceReader, clock: Clock, out: Path, earlier: Dump | None, log: FrameLog, progress: Progress
) -> DumpResult:
    resume_at = earlier.whole_bytes if earlier is not None else 0 if out.exists() and not out.stat().st_size else None
    writer = DumpWriter(out, resume_at=resume_at)
    try:
        head = started(job, clock)
        writer.write({"resumed": head["started"]} if earlier is not None else head)
        return await Dumper(job, asker, clock, writer, log, earlier, progress).run()
    finally:
        writer.close()
