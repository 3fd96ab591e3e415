"""A run in virtual time, of one system or of several that run together: ``fieldtwin simulate SYSTEM --seed 7 --for 24h``.

Everything happens in this thread, without access to clocks, sockets and threads; between two pieces of the run that
access is allowed, to report progress. Every event that is the same in each run with the same seed is traced and hashed.
"""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fieldtwin.emulators.faults.schema import load_faults
from fieldtwin.emulators.virtual.chance import seeded
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.emulators.virtual.seal import sealed
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, UsageError
from fieldtwin.results.model import Verdict
from fieldtwin.results.trace import Trace, open_sink
from fieldtwin.results.trace_about import CheckAbout, TraceAbout, write_results
from fieldtwin.run.processes.topside import Scripted
from fieldtwin.run.virtual.fault_schedule import RandomFaults, random_schedule
from fieldtwin.run.virtual.group_kinds import VirtualSystems, virtual_kind
from fieldtwin.run.virtual.guided_faults import guide_of
from fieldtwin.run.virtual.recorded_variables import RecordedVariables
from fieldtwin.run.virtual.system_check import SystemCheck
from fieldtwin.run.virtual.trace_description import begin_description
from fieldtwin.scenarios.bench import Bench
from fieldtwin.twin.prototype.field_process import FieldConfig, resolve
from fieldtwin.twin.prototype.group import SystemGroup, load_group, one_system

PIECE_S = 10.0
"""Virtual seconds between two progress reports, and between two checks."""
MAX_ERRORS = 100
MOST_REASON = 2000
"""Maximum number of characters of the errors in the description of a trace."""


@dataclass(frozen=True)
class VirtualOptions:
    """The options of a run. `system` names the file of one system or of several; the duration is in virtual seconds.

    `faults`, and those of the file `fault_file`, are injected in addition to those of `random_faults`, which the seed
    chooses; `trace` is a file for every event, and `most_trace_bytes` limits it (see `open_sink`). `variables` of programs are
    events of the trace as well (`RecordedVariables`). `commands`: the sample
    periods in seconds that are commanded; None: the usual commands. `prototype_file`, `recordings` and `speed` are for one
    system.
    """

    system: str
    duration_s: float
    seed: int | None = None
    profiles: tuple[Path, ...] = ()
    prototype_file: Path | None = None
    recordings: dict[str, str] = field(default_factory=dict)
    speed: float = 0.0
    commands: tuple[int, ...] | None = ()
    faults: tuple[dict[str, Any], ...] = ()
    fault_file: Path | None = None
    random_faults: RandomFaults | None = None
    trace: Path | None = None
    most_trace_bytes: int | None = field(default=None, repr=False)  # no part of a campaign's fingerprint
    variables: tuple[str, ...] = field(default=(), repr=False)


def load_one(options: VirtualOptions) -> SystemGroup:
    """Read the files of one system and check that its prototype can be made. Raises `FileInvalid` and `UsageError`."""
    config = FieldConfig(
        system=options.system,
        run_dir="",
        prototype=str(options.prototype_file) if options.prototype_file else "",
        profiles=tuple(map(str, options.profiles)),
        recordings=options.recordings,
        speed=options.speed,
    )
    twin = resolve(config)
    return one_system(twin.ecs.system, twin.prototype)


def texts_of(group: SystemGroup) -> tuple[str, ...]:
    """Return the texts of the files that the runs of these systems depend on, or their hashes."""
    own = (group.path.read_text(encoding="utf-8"),) if group.kind else ()
    members = group.members.values()
    return *own, *(text for m in members for text in (m.system.hash, m.prototype.path.read_text(encoding="utf-8")))


class VirtualRun:
    """One run: ``run()``, then `summary()`. `errors` are those of the run itself.

    `checks` are those of each system, by its name in `group`. Raises `FileInvalid` and `UsageError` for files and options
    that make no sense.
    """

    def __init__(self, options: VirtualOptions) -> None:
        self.options = options
        self.group = load_group(options.system, options.profiles) or load_one(options)
        self._kind = virtual_kind(self.group)
        self.seed = self.group.seed if options.seed is None else options.seed
        self.given_faults = options.faults
        """The injected faults, without the faults that the seed chose."""
        if options.fault_file is not None:
            self.given_faults += load_faults(options.fault_file, self.group.check_fault)
        self.faults = self.given_faults
        if options.random_faults is not None:
            options.random_faults.check(self.group)
            self.faults += random_schedule(self.group, self.seed, options.duration_s, options.random_faults)
        self._guide = guide_of(self.group, self.seed, options.duration_s, options.random_faults)
        placed, disturbed = self.group.place(self.faults), None if self._guide is None else True
        self.checks = {
            name: SystemCheck(m.system, placed.get(name, ()), disturbed=disturbed)
            for name, m in self.group.members.items()
        }
        self.elapsed_s = 0.0
        self.errors: list[str] = []
        self.trace = Trace(0)  # nothing reads its events; the hash, the listeners and a trace file get all of them
        self._shared: dict[str, Any] = {}
        self._about: TraceAbout | None = None
        """The description of the trace, if there is one."""
        self._judged = False
        """Whether the checks of the run have begun. An invalid file or option that is found before that is raised."""

    @property
    def scripted(self) -> list[Scripted]:
        """Return the commands of the run with their times; empty if no part of the group can send commands."""
        return self._kind.scripted(self.group, self.options.commands, self.options.duration_s)

    @property
    def files(self) -> tuple[str, ...]:
        """Return the texts of the files that the run depends on, or their hashes; a changed file changes the result."""
        return texts_of(self.group)

    def run(
        self, progress: Callable[[float], None] | None = None, watch: Callable[[Trace], None] | None = None
    ) -> None:
        """Run the systems. `progress` is called from time to time with the elapsed virtual seconds. `watch` gets the trace before
        its first event, to listen to it.

        Raises `FileInvalid` where the trace cannot be written, and `UsageError` for options that make no sense in this
        system.
        """
        loop = VirtualLoop()
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ft-virtual-")))
            file = self.options.trace
            self.trace = Trace(0, open_sink(file, self.options.most_trace_bytes) if file else None)
            stack.callback(self.trace.close)
            if self._guide is not None:
                self._guide.listen(self.trace)
            if watch is not None:
                watch(self.trace)
            stack.callback(loop.close)
            stack.enter_context(seeded(self.seed))
            with sealed():
                main = loop.create_task(self._main(loop, folder), name="run")
                main.add_done_callback(lambda _: loop.stop())
            while not main.done():
                with sealed():
                    loop.run_forever()
                if progress is not None:
                    progress(self.elapsed_s)
            self._ended(main, loop)
        if self.options.trace is not None:
            summary = self.summary()
            broken = [
                CheckAbout(
                    number=one["number"],
                    text=one["text"],
                    verdict=one["verdict"],
                    got=one["got"],
                    where=one["where"],
                    t_ns=None if one["broken_s"] is None else round(one["broken_s"] * NS_PER_S),
                )
                for one in summary.get("invariants", ())
            ]
            verdict = Verdict.PASSED if summary["ok"] else Verdict.FAILED
            reason = "; ".join(map(str, summary.get("errors", ())))[:MOST_REASON]
            write_results(self.options.trace, self._about, verdict=verdict.value, reason=reason, checks=broken)

    async def _main(self, loop: VirtualLoop, folder: Path) -> None:
        kind, group, commands = self._kind, self.group, self.scripted
        async with kind.virtual(group, loop, folder, self.trace, self.seed, commands) as running:
            recorded = RecordedVariables(running, self.options.variables) if self.options.variables else None
            self.attach(running)
            if self.options.trace is not None:
                self._about = begin_description(
                    self.options.trace,
                    group,
                    running,
                    seed=self.seed,
                    profiles=self.options.profiles,
                    recorded=recorded.variables if recorded is not None else (),
                )
            for fault in self.faults:  # each has its own start time
                await running.bench.inject(fault)
            async with Nursery() as nursery:
                for name, check in self.checks.items():
                    check.watch_invariants(running.systems[name], nursery)
                if self._guide is not None:
                    nursery.start(self._guide.run(running.bench), "guided faults")
                await self._through(running.bench, loop, lambda: self._judge(running))
                for name, check in self.checks.items():
                    await check.settle(running.systems[name])
            if running.topside is not None:
                await running.topside.halt()
            for name, check in self.checks.items():
                await check.finish(running.systems[name])
            self._shared = running.results()

    def attach(self, running: VirtualSystems) -> None:
        """Begin to check the events of the systems."""
        self._judged = True
        for name, check in self.checks.items():
            check.attach(running.systems[name])

    def _judge(self, running: VirtualSystems) -> None:
        for name, check in self.checks.items():
            check.check(running.systems[name])

    async def _through(self, bench: Bench, loop: VirtualLoop, judge: Callable[[], None]) -> None:
        """Advance to the end of the run, `PIECE_S` at a time, and call `judge` after each piece."""
        while (left_s := self.options.duration_s - bench.now_s()) > 0:
            await bench.sleep_until_s(bench.now_s() + min(left_s, PIECE_S))
            self.elapsed_s = bench.now_s()
            judge()
            await self.pause(loop)

    async def pause(self, loop: VirtualLoop) -> None:
        """Interrupt the loop, so that `progress` is called."""
        loop.stop()
        await asyncio.sleep(0)

    def _ended(self, main: asyncio.Task[None], loop: VirtualLoop) -> None:
        if self._guide is not None:
            self.faults += tuple(self._guide.chosen)
            for name, faults in self.group.place(self._guide.chosen).items():
                self.checks[name].faults = (*self.checks[name].faults, *faults)
        error = None if main.cancelled() else main.exception()
        if isinstance(error, FileInvalid | UsageError) and not self._judged:
            raise error
        if isinstance(error, FieldtwinError):
            self.errors.append(str(error))
        elif error is not None:
            raise error
        for context in loop.unhandled[:MAX_ERRORS]:
            self.errors.append(
                f"unhandled exception: {context.get('message')} {context.get('exception') or ''}".strip()
            )

    def summary(self) -> dict[str, Any]:
        """Return plain data, with seed and trace; it does not depend on the speed of the run."""
        return {
            **self._kind.summary(self.group, self.checks, self._shared, self.errors, self.elapsed_s),
            "virtual": True,
            "seed": self.seed,
            "trace": {"events": self.trace.count, "sha256": self.trace.hexdigest()},
            "virtual_s": round(self.elapsed_s, 3),
        }
