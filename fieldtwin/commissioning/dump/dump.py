"""Dump a device: send the questions of a sweep, and write down every answer before the next question.

An interrupted dump is continued by starting the sweep again and answering its questions from the file until the recorded
answers are used up. This module must never write to the device, and sends only requests that are logged.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from fieldtwin.commissioning.access.frame_log import FrameLog
from fieldtwin.commissioning.access.reading import DeviceTarget
from fieldtwin.commissioning.dump.asking import PROBES, AskResult, DeviceReader
from fieldtwin.commissioning.dump.beyond import beyond_silence, other_lengths
from fieldtwin.commissioning.dump.file import (
    LATENCY_LIMITS_NS,
    TABLES,
    VERSION,
    Dump,
    DumpWriter,
    Pass,
    describe_latency,
    key_of,
    map_line,
    outcome_of,
    take_read,
)
from fieldtwin.commissioning.dump.objects import EVERYTHING, ListedObjects, ObjectKey, ObjectSweep, of_dictionary
from fieldtwin.commissioning.dump.profile import ProfileSweep, dumped_tags
from fieldtwin.commissioning.dump.sweep import Invalid, Outcome, RefusedRead, Silent, Sweep, TableMap, Taken
from fieldtwin.gateway.core.clock import NS_PER_S, NS_PER_US, Clock
from fieldtwin.gateway.core.errors import FileInvalid, Unreachable
from fieldtwin.gateway.core.files.profile import RegisterRange, gap_text
from fieldtwin.gateway.core.histogram import Histogram
from fieldtwin.results.subject import who

DEFAULT_BUDGET_S = 600.0
ALL_TABLES = tuple(RegisterRange(table, 0, 65536) for table in TABLES)
NOT_OF_THE_JOB = ("ended", "latency", "resumed")
"""The kinds of lines that describe a session and not the dump, so that they are ignored when a dump is continued."""

Progress = Callable[[int, int, int], None]
"""A function called with ``(done, total, requests)``: the number of addresses (or, in a later pass, of reads) that are
done, the number of all, and the number of requests sent.
"""
Sweeping = Sweep | ProfileSweep | ObjectSweep | ListedObjects


@dataclass(frozen=True, slots=True)
class DumpJob:
    """The task of a dump.

    For Modbus it reads `spans`, or the profile's tags if there are none; for CANopen `objects`, or the EDS's. `stride` is that of
    `Sweep`; `most` is the longest read to try; `pairs`: the device has pairs of registers only. It makes `passes` passes, one
    every `every_s` seconds from start to start. `functions`: find out which functions that only read exist. `budget_s`: the time
    that each table (or the objects) may take for requests without a result, where the device is silent or allows a value to be
    read only whole. `spacing_s`: the pause after each request, which is counted as part of that time.
    """

    target: DeviceTarget
    spans: tuple[RegisterRange, ...] = ()
    objects: tuple[tuple[int, int], ...] = ()
    stride: int = 8
    most: int | None = None
    pairs: bool = False
    passes: int = 1
    every_s: float = 0.0
    functions: bool = True
    budget_s: float = DEFAULT_BUDGET_S
    spacing_s: float = 0.0

    def header(self) -> dict[str, Any]:
        """Return the properties that two dumps of the same job share; the endpoint is not one of them, because it may change."""
        target = self.target
        ranges = [gap_text(s) for s in self.spans] or [f"{a:04X}h..{b:04X}h" for a, b in self.objects]
        return {
            "fieldtwin_dump": VERSION,
            "protocol": target.protocol,
            "address": target.address,
            "ranges": ranges,
            "profile": target.profile.name if target.profile is not None else None,
            "profile_hash": target.profile.hash if target.profile is not None else None,
            "eds": target.dictionary.path if target.dictionary is not None and not self.objects else None,
            "stride": self.stride,
            "most": self.most,
            "pairs": self.pairs,
            "budget_s": self.budget_s,
        }

    def sweeps(self) -> list[Sweeping]:
        """Return the sweeps of the first pass, one for each range or table."""
        target, budget_us = self.target, round(self.budget_s * 1e6)
        if target.protocol == "canopen":
            if self.objects or target.dictionary is None:
                return [ObjectSweep(self.objects or EVERYTHING, budget_us)]
            return [of_dictionary(target.dictionary, budget_us)]
        if not self.spans and target.profile is not None:
            return [ProfileSweep(target.profile, dumped_tags(target.profile)[0], budget_us)]
        grain = 2 if self.pairs else 1
        return [
            Sweep(
                span,
                most=self.most,
                stride=self.stride,
                grain=1 if span.table in ("coil", "discrete") else grain,
                budget_us=budget_us,
                spacing_us=round(self.spacing_s * 1e6),
            )
            for span in self.spans or ALL_TABLES
        ]


@dataclass
class DumpResult:
    """The result of a dump. `requests` counts those sent in this session, `replayed` the questions answered from the file."""

    maps: list[TableMap] = field(default_factory=list)
    functions: dict[int, dict[str, Any]] = field(default_factory=dict)
    latency: dict[str, Histogram] = field(default_factory=dict)
    requests: int = 0
    replayed: int = 0
    answered: int = 0


class Dumper:
    """One session of a dump job. `earlier` is the dump that is continued (None: a new dump)."""

    def __init__(
        self,
        job: DumpJob,
        asker: DeviceReader,
        clock: Clock,
        writer: DumpWriter,
        log: FrameLog | None = None,
        earlier: Dump | None = None,
        progress: Progress = lambda done, total, requests: None,
    ) -> None:
        self._job, self._asker, self._clock, self._writer, self._log = job, asker, clock, writer, log
        lines = earlier.lines if earlier is not None else []
        self._recorded = deque(line for line in lines if not line.keys() & set(NOT_OF_THE_JOB))
        self._progress = progress
        self._so_far = Dump("", job.header())
        self.result = DumpResult()

    async def run(self) -> DumpResult:
        """Run all passes and return the result.

        Raises `Unreachable` if the device answered no request at all, and errors that end a connection; the answers received
        until then are in the file.
        """
        result = self.result
        self._pass(0)
        sweeps = self._job.sweeps()
        total, done = sum(_size(s) for s in sweeps), 0
        for sweep in sweeps:
            await self._follow(sweep, sweep.asking(), done, total)
            done += _size(sweep)
        if self._job.functions and self._job.target.protocol == "modbus":
            await self._functions()
        if not result.answered:
            raise Unreachable("nobody answers", where=f"{self._job.target.url} address {self._job.target.address}")
        # the functions are tested after the first reads, so that a missing device is reported soon
        for sweep in sweeps:
            if isinstance(sweep, Sweep):
                await self._follow(sweep, beyond_silence(sweep), total, total)
                await self._follow(sweep, other_lengths(sweep), total, total)
        for sweep in sweeps:
            self._map(sweep)
        for number in range(1, self._job.passes):
            await self._again(number, sweeps)
        self._writer.write({"latency": {name: describe_latency(h) for name, h in sorted(result.latency.items())}})
        self._writer.write({"ended": _iso(self._clock.utc_ns()), "requests": result.requests})
        return result

    # -- passes ---------------------------------------------------------------------------------------------------

    async def _follow(self, sweep: Sweeping, asking: Generator[Any, Outcome, None], done: int, total: int) -> None:
        try:
            asked = next(asking)
            while True:
                outcome = await self._outcome(asked, patient=sweep.patient)
                self._progress(min(total, done + _place(sweep, asked)), total, self.result.requests)
                asked = asking.send(outcome)
        except StopIteration:
            pass

    def _map(self, sweep: Sweeping) -> None:
        if isinstance(sweep, ObjectSweep | ListedObjects):
            self._write(self._objects_line(sweep))
            return
        for found in sweep.maps.values() if isinstance(sweep, ProfileSweep) else [sweep.found]:
            self.result.maps.append(found)
            self._write(map_line(self._so_far, found.table, _map_line(found)))

    def _objects_line(self, sweep: ObjectSweep | ListedObjects) -> dict[str, Any]:
        """Return the line of the dump file with the number of objects in each state, and of those that were not requested."""
        first = self._so_far.passes[0]
        indexes = {index for cells in (first.cells, first.refused, first.silent, first.invalid) for index, _ in cells}
        if isinstance(sweep, ListedObjects):
            known = {*first.cells, *first.refused, *first.silent, *first.invalid}
            not_asked = sum((k.index, k.subindex) not in known for k in sweep.keys)
        else:
            not_asked = sum(i not in indexes for low, high in sweep.ranges for i in range(low, high + 1))
        return {
            "map": "objects",
            "counts": {
                "readable": len(first.cells), "refused": len(first.refused), "silent": len(first.silent),
                "invalid": len(first.invalid), "not_asked": not_asked,
                "unknown": len(first.silent) + len(first.invalid) + not_asked,
            },
            "stopped": sweep.stopped,
        }  # fmt: skip

    async def _again(self, number: int, sweeps: Sequence[Sweeping]) -> None:
        """Make a later pass: read the readable addresses of the first pass in the fewest reads."""
        if not self._recorded and self._job.every_s:
            await self._clock.sleep_until_ns(self._pass_ns + round(self._job.every_s * NS_PER_S))
        self._pass(number)
        reads: list[RegisterRange | ObjectKey] = []
        for sweep in sweeps:
            if isinstance(sweep, Sweep):
                reads += sweep.found.reads()
            elif isinstance(sweep, ProfileSweep):
                reads += sweep.reads()
        reads += [ObjectKey(*key) for key in self._objects_found]
        for i, asked in enumerate(reads):
            await self._read_again(asked)
            self._progress(i + 1, len(reads), self.result.requests)

    async def _read_again(self, asked: RegisterRange | ObjectKey) -> None:
        """Repeat a read. If it is refused, read its two halves: the device may not accept a read across the border between
        two earlier sweeps.
        """
        outcome = await self._outcome(asked)
        if isinstance(outcome, RefusedRead) and isinstance(asked, RegisterRange) and asked.count > 1:
            half = asked.count // 2
            await self._read_again(RegisterRange(asked.table, asked.address, half))
            await self._read_again(RegisterRange(asked.table, asked.address + half, asked.count - half))

    async def _functions(self) -> None:
        for number, request in PROBES:
            taken = self._next_recorded("function", number)
            if taken is None:
                asked = await self._ask(lambda request=request: self._asker.function(request))  # type: ignore[misc]
                taken = {"function": number} | _line(asked)
                self._writer.write(taken)
            self._count(number, taken)
            self.result.functions[number] = taken

    # -- one question ---------------------------------------------------------------------------------------------

    async def _outcome(self, asked: RegisterRange | ObjectKey, *, patient: bool = True) -> Outcome:
        key = key_of(asked)
        line = self._next_recorded("read", key)
        if line is None:
            line = {"read": key} | _line(await self._ask(lambda: self._asker.read(asked, patient=patient)))
            self._writer.write(line)
        outcome = outcome_of(line)
        if len(self._so_far.passes) == 1:
            take_read(self._so_far, line)
        if isinstance(asked, ObjectKey) and isinstance(outcome, Taken):
            self._objects_found[(asked.index, asked.subindex)] = None
        self._count(_function(asked), line)
        return outcome

    async def _ask(self, question: Callable[[], Any]) -> AskResult:
        if self._log is not None and self._log.full:
            raise FileInvalid("the log of sent frames is full", path=str(self._log.path), hint="move it, then --resume")
        asked: AskResult = await question()
        self.result.requests += asked.requests
        return asked

    def _count(self, function: int, line: dict[str, Any]) -> None:
        self.result.answered += "silent" not in line and "invalid" not in line
        if "hex" in line:  # a device refuses faster than it reads, so refusals are left out
            name = f"{function:02X}" if function else "SDO"
            self.result.latency.setdefault(name, Histogram(LATENCY_LIMITS_NS)).record(int(line["us"]) * NS_PER_US)

    # -- the file -------------------------------------------------------------------------------------------------

    def _pass(self, number: int) -> None:
        self._pass_ns = self._clock.monotonic_ns()
        self._objects_found: dict[tuple[int, int], None] = self._objects_found if number else {}
        self._so_far.passes.append(Pass(0))
        self._write({"pass": number, "at": _iso(self._clock.utc_ns())})

    def _write(self, line: dict[str, Any]) -> None:
        """Write a line, unless an earlier session of the same dump wrote it."""
        what = next(iter(line))
        if self._next_recorded(what, line[what]) is None:
            self._writer.write(line)

    def _next_recorded(self, what: str, name: object) -> dict[str, Any] | None:
        if not self._recorded:
            return None
        line = self._recorded.popleft()
        if line.get(what) != name:
            raise FileInvalid(
                "the dump to continue was made with different options", path=str(self._writer.path), expected=str(name),
                got=str(line)[:60], hint="start another file",
            )  # fmt: skip
        self.result.replayed += 1
        return line


def check_resumable(job: DumpJob, earlier: Dump) -> None:
    """Raise `FileInvalid` when `earlier` is the dump of a different job."""
    now = job.header()
    different = [key for key, value in now.items() if earlier.header.get(key) != value]
    if different:
        raise FileInvalid(
            "this is the dump of a different device or range",
            path=earlier.path,
            expected=", ".join(f"{key} {now[key]!r}" for key in different),
            got=", ".join(repr(earlier.header.get(key)) for key in different),
        )


def started(job: DumpJob, clock: Clock) -> dict[str, Any]:
    """Return the header line of a new dump."""
    return job.header() | {"endpoint": job.target.url, "started": _iso(clock.utc_ns()), "by": who()}


def _map_line(found: TableMap) -> dict[str, Any]:
    return {
        "map": found.table,
        "borders": sorted(set(found.borders)),
        "units": [list(unit) for unit in found.units],
        "max_read": found.max_read,
        "limit_proved": found.limit_proved,
        "pairs": found.grain == 2,
        "codes": {f"{code:02X}": n for code, n in found.codes.items()},
        "function_refused": found.function_refused,
        "lengths": found.lengths,
        "stopped": found.stopped,
    }


def _line(asked: AskResult) -> dict[str, Any]:
    outcome = asked.outcome
    if isinstance(outcome, Taken):
        return {"hex": outcome.raw.hex(), "us": asked.us}
    if isinstance(outcome, RefusedRead):
        return {"code": outcome.code, "us": asked.us}
    if isinstance(outcome, Invalid):
        return {"invalid": outcome.problem, "us": asked.us} | ({"values": outcome.values} if outcome.values else {})
    assert isinstance(outcome, Silent)
    return {"silent": outcome.problem, "us": asked.us}


def _function(asked: RegisterRange | ObjectKey) -> int:
    return {"coil": 1, "discrete": 2, "holding": 3, "input": 4}[asked.table] if isinstance(asked, RegisterRange) else 0


def _size(sweep: Sweeping) -> int:
    if isinstance(sweep, Sweep):
        return sweep.span.count
    if isinstance(sweep, ObjectSweep):
        return sum(last - first + 1 for first, last in sweep.ranges)
    return len(sweep.keys) if isinstance(sweep, ListedObjects) else sum(r.range.count for r in sweep.plan.reads)


def _place(sweep: Sweeping, asked: RegisterRange | ObjectKey) -> int:
    """Return the number of addresses or indices of `sweep` that are done when it asks for `asked`."""
    if isinstance(sweep, Sweep) and isinstance(asked, RegisterRange):
        return asked.address - sweep.span.address
    if isinstance(sweep, ObjectSweep) and isinstance(asked, ObjectKey):
        return sum(max(0, min(last, asked.index) - first + 1) for first, last in sweep.ranges)
    return 0


def _iso(utc_ns: int) -> str:
    return datetime.fromtimestamp(utc_ns / NS_PER_S, UTC).isoformat(timespec="milliseconds")
