"""The runner of a PLC's tasks: it runs the tasks by priority, one after the other, and restarts programs after some failures.

Tasks are cyclic (INTERVAL) or run once at each rising edge of a tag (SINGLE), as in IEC 61131-3, 6.8.2. They share one thread,
so a task is never interrupted. Of the tasks that are due, the one with the smallest PRIORITY number runs first; among equals,
the one that has waited longest. If one task stops by itself, all tasks stop, and the outputs are set to their safe values.
After a stop by the watchdog, or a scan that did not end, the programs are created again and start warm, at most `max_restarts`
times in a row. A program runs only after its inputs have been good once (fieldtwin.plc.cycle.start), also after a restart.

Like a `CyclicTask`, the runner provides `deadline_ns` and `run_once`. It cannot distinguish the wall clock from virtual time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.core.errors import Bug, FieldtwinError, FileInvalid, UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.image.image import INPUTS, Image, TagSpec, consumed_name
from fieldtwin.gateway.core.image.layout import RegionLayout
from fieldtwin.gateway.core.values import Quality, Reason, Scalar, TagValue
from fieldtwin.plc.binding import BoundProgram, created_again
from fieldtwin.plc.cycle.forces import Forces, checked
from fieldtwin.plc.cycle.publishing import OutputImage, TagChange
from fieldtwin.plc.cycle.scan import Scan
from fieldtwin.plc.cycle.start import InputsMissing, Starts
from fieldtwin.plc.cycle.task import CyclicTask, Guard, StopReason, TaskConfig, TaskState
from fieldtwin.plc.program import Program, Role
from fieldtwin.plc.runtime.config import PlcConfig, TaskSpec
from fieldtwin.plc.runtime.retain import Retained
from fieldtwin.plc.runtime.sources import ProgramSource, sources
from fieldtwin.plc.status import PlcStatus, StopsStatus, TaskStatus

RESTARTABLE = (StopReason.WATCHDOG, StopReason.STUCK)
STEADY_NS = 60 * NS_PER_S
"""After this running time, earlier restarts no longer count."""
_NEVER_NS = 2**62
_STOPPED = TaskState.STOPPED  # a local name, because looking up an Enum's members is slow
_EVENT_MS = 1e9
_ROUNDING = 1e-9  # intervals such as 0.3 ms are not exact multiples of each other in binary


@dataclass
class TaskEntry:
    """A task, its scan, and for a SINGLE task the state of its trigger at the last check."""

    spec: TaskSpec
    scan: Scan
    task: CyclicTask
    before: bool = True

    @property
    def single(self) -> str:
        return self.spec.single


class TaskRunner:
    """All tasks of a PLC, which use one attached process image. Raises `FileInvalid` for a configuration that cannot run, and
    `Unreachable` if retained variables cannot be kept.
    """

    def __init__(
        self,
        config: PlcConfig,
        image: Image,
        now_ns: Callable[[], int],
        guard: Guard | None = None,
        on_change: Callable[[TagChange], None] | None = None,
        *,
        modules: bool = True,
    ) -> None:
        """Create the runner. `on_change` is called whenever a program changes an output or a local.

        `modules`: whether `sources` also lists the imported modules in the folders of the programs. Finding them takes 10 ms.
        """
        self.config = config
        self.forces = Forces()
        self.restarts = 0
        self._stops = 0
        self._last_stop = ""
        self.entries: list[TaskEntry] = []
        self._triggered: list[TaskEntry] = []
        """The SINGLE tasks."""
        self.programs: list[BoundProgram] = []
        self.sources: list[ProgramSource] = []
        """The files from which the programs were created."""
        self.outputs: OutputImage
        self.retained: Retained
        self.starts: Starts
        self._limits: dict[str, tuple[float, float] | None] = {}
        self._on_change = on_change
        self._modules = modules
        self._image = image
        self._now_ns = now_ns
        self._guard = guard
        self._in_a_row = 0
        self._restart_ns = _NEVER_NS
        self._started_ns = 0
        self._began = False
        self._stopped: TaskEntry | None = None
        self._ran: TaskEntry | None = None
        self._stepped = 0
        self._ended: StopReason | None = None
        self._between: Callable[[], None] | None = None
        self._every_scan = False
        self.on_scan: Callable[[TaskEntry], None] | None = None
        """A function that is called after each scan, also of a paused PLC. It must not raise an exception."""
        self._assemble(self._loaded(), cold=config.cold)
        self.sources = self._read_sources()

    # -- assembly -----------------------------------------------------------------------------------------------------

    def _loaded(self) -> list[BoundProgram]:
        """Read the programs and create instances. Raises `FileInvalid` if they cannot run with the process image."""
        # created with the programs, so that global variables also begin with their initial values
        together: dict[Any, Any] = {}
        programs = [p.bind(self.config.python_path, together) for p in self.config.programs]
        readers, before = self.readers(), self.programs
        return (
            [_fitted(new, old, readers, together) for new, old in zip(programs, before, strict=True)]
            if before
            else programs
        )

    def _created_again(self) -> list[BoundProgram]:
        """Create new instances of the programs that ran, without reading their files. Raises `FileInvalid`."""
        together: dict[Any, Any] = {}
        return [
            replace(bound, program=created_again(p.source, bound.program, together))
            for bound, p in zip(self.programs, self.config.programs, strict=True)
        ]

    def readers(self) -> dict[str, list[str]]:
        """Return what uses variables of programs, by tag: other programs, the tasks that they trigger, and `PlcConfig.users`."""
        found = {tag: list(users) for tag, users in self.config.users.items()}
        for bound in self.programs:
            for binding in bound.inputs.values():
                found.setdefault(binding.tag, []).append(f"program {bound.name}")
        for spec in self.config.tasks:
            if spec.single:
                found.setdefault(spec.single, []).append(f"task {spec.name}")
        return {tag: list(dict.fromkeys(users)) for tag, users in found.items()}

    def _assemble(self, programs: list[BoundProgram], cold: bool) -> None:
        config = self.config
        self.programs = programs
        path = Path(config.retain_path) if config.retain_path else None
        self.retained = Retained(self.programs, path, cold=cold)
        self.outputs = OutputImage(self._image, self.programs, self.forces)
        self.outputs.on_change = self._on_change
        specs = config.tasks or (TaskSpec("main", config.cycle_ms),)
        self._check(specs)
        self.entries = []
        single = {spec.name for spec in specs if spec.single}
        self.starts = Starts(
            self._image,
            [(b, p.start) for b, p in zip(self.programs, config.programs, strict=True)],
            self.forces,
            config.heartbeat_limit_ms,
            [p.name for p in config.programs if (p.task or specs[0].name) in single],
        )
        for spec in specs:
            mine = [
                b for b, p in zip(self.programs, config.programs, strict=True) if (p.task or specs[0].name) == spec.name
            ]
            scan = Scan(
                self._image,
                mine,
                config.heartbeat_limit_ms,
                self.outputs,
                outputs_first=config.outputs_first,
                starts=self.starts.all,
                # programs of one file share global variables, also those of different tasks
                may_skip=len(specs) == 1 and not self._every_scan,
            )
            cycle_ms = _EVENT_MS if spec.single else spec.interval_ms
            timing = TaskConfig(cycle_ms, spec.late_ms or config.late_ms, config.stop_after, spec.name)
            self.entries.append(TaskEntry(spec, scan, CyclicTask(scan, timing, self._now_ns, self._guard)))
        self._triggered = [entry for entry in self.entries if entry.single]

    def _check(self, specs: tuple[TaskSpec, ...]) -> None:
        names = [s.name for s in specs]
        tags = {tag.name for region in self._image.layout.regions for tag in region.tags}
        for n, spec in enumerate(specs):
            if spec.name in names[:n]:
                raise FileInvalid(f"task {spec.name} is defined twice")
            if bool(spec.single) == (spec.interval_ms > 0):
                raise FileInvalid(f"task {spec.name}", expected="an interval above 0, or a trigger (single)")
            if spec.single and spec.single not in tags:
                raise FileInvalid(f"the trigger of task {spec.name} does not exist", got=spec.single)
        if all(s.single for s in specs):
            raise FileInvalid(
                "only SINGLE tasks", expected="at least one task with an interval, which checks their triggers"
            )
        for p in self.config.programs:
            if p.task and p.task not in names:
                raise FileInvalid(
                    f"program {p.name} is in task {p.task}", expected=f"one of {', '.join(sorted(names))}"
                )

    def _start_all(self) -> None:
        self._started_ns = self._now_ns()
        for entry in self.entries:
            entry.task.start()
            if entry.single:
                entry.task.deadline_ns = _NEVER_NS

    # -- execution ----------------------------------------------------------------------------------------------------

    def start(self) -> None:
        self._began = True
        self._start_all()

    @property
    def running(self) -> bool:
        """Return whether there is a scan or a restart to wait for."""
        return self._ended is None and self._began

    @property
    def deadline_ns(self) -> int:
        if self._stopped is not None:
            return self._restart_ns
        if len(self.entries) == 1:
            return self.entries[0].task.deadline_ns
        return min(entry.task.deadline_ns for entry in self.entries)

    def between_scans(self, action: Callable[[], None]) -> None:
        """Carry out `action` once, after the next scan, when most of the time until the following one is left.

        It must not raise an error. It is not called if the PLC ends before.
        """
        self._between = action

    def run_once(self) -> None:
        """Execute the scan or the restart that is due first."""
        self._run_due()
        if self._between is not None:
            action, self._between = self._between, None
            action()

    def execute_every_scan(self, *, always: bool = True) -> None:
        """From now on execute the logic of each scan, also if that changes nothing, because a debugger or a trace looks at it.

        With `always` False, end that.
        """
        self._every_scan = always
        for entry in self.entries:
            entry.scan.may_skip(skip=len(self.entries) == 1 and not always)

    def excuse(self) -> None:
        """Count no overrun for the next scan of each task, because a debugger has stopped the present one."""
        for entry in self.entries:
            entry.task.excused = True

    def programs_changed(self, read: Sequence[ProgramSource]) -> None:
        """Continue with programs that were replaced in place. `read` are their files."""
        names = {source.program for source in read}
        self.sources = [*read, *(source for source in self.sources if source.program not in names)]
        for entry in self.entries:
            entry.scan.programs_changed()

    def _run_due(self) -> None:
        if self._ended is not None or not self._began:
            raise Bug("a scan of a PLC that does not run")
        now_ns = self._now_ns()
        if self._stopped is not None:
            if now_ns >= self._restart_ns:
                self._restart_by_itself(self._stopped)
            return
        entry = self.entries[0] if len(self.entries) == 1 else self._next(now_ns)
        self._look_for_delay(entry)
        stepped = entry.task.paused and entry.task.steps > 0
        if self.starts.waiting and (stepped or not self.paused):
            try:
                self.starts.look(now_ns)
            except InputsMissing as e:
                entry.task.fail(e, StopReason.NOT_STARTED)
                self._on_stopped(entry)
                return
        entry.task.run_once()
        self._ran = entry
        if self.on_scan is not None:
            self.on_scan(entry)
        if entry.task.state is _STOPPED:
            self._on_stopped(entry)
            return
        if self._triggered:
            if entry.single:
                entry.task.deadline_ns = _NEVER_NS
            self._look_at_triggers(entry.scan, stepped=stepped)
        if self._in_a_row and now_ns - self._started_ns > STEADY_NS:
            self._in_a_row = 0
        try:
            self.retained.save()
        except FieldtwinError as e:
            entry.task.error = e
            entry.task.stop()
            self._on_stopped(entry)

    @property
    def period_ns(self) -> int:
        """Return the time in ns between two scans of the first task."""
        return self.entries[0].task.period_ns

    def repeats_until(self, until_ns: int) -> bool:
        """Return whether every scan before `until_ns` would only repeat the last one, see `Cycle`."""
        return (
            len(self.entries) == 1
            and self._between is None
            and self._stopped is None
            and not self.starts.waiting
            and not self._in_a_row
            and self.entries[0].task.repeats_until(until_ns)
        )

    def skip(self, count: int, last_ns: int) -> None:
        """Count scans of the only task that do not take place, see `Cycle`."""
        self.entries[0].task.skip(count, last_ns)

    def _look_for_delay(self, entry: TaskEntry) -> None:
        """Record which task was still running when `entry` became due, because it may have caused the late scan."""
        before = self._ran
        if before is not None and before is not entry:
            held_up = before.task.ended_ns > entry.task.deadline_ns
            took_ms = before.task.duration.max_ns / 1e6
            entry.task.held_up_by = (
                f"task {before.spec.name} (its longest scan took {took_ms:.3f} ms)" if held_up else ""
            )
        else:
            entry.task.held_up_by = ""

    def _next(self, now_ns: int) -> TaskEntry:
        """Return the task of the highest priority of those that are due; if none is due, the task that will be due
        first."""
        due = [e for e in self.entries if e.task.deadline_ns <= now_ns]
        if not due:
            return min(self.entries, key=lambda e: e.task.deadline_ns)
        return min(due, key=lambda e: (e.spec.priority, e.task.deadline_ns))

    def _look_at_triggers(self, scan: Scan, *, stepped: bool) -> None:
        for entry in self._triggered:
            value = scan.value(entry.single)
            if value is None:
                continue  # the value is unknown, and a rising edge must not be guessed
            now = bool(value)
            if now and not entry.before:
                entry.task.deadline_ns = self._now_ns()
                entry.task.steps += stepped
            entry.before = now

    def _on_stopped(self, entry: TaskEntry) -> None:
        for other in self.entries:
            other.task.stop()
        self._stopped = entry
        if entry.task.stop_reason in RESTARTABLE and self._in_a_row < self.config.max_restarts:
            self._stops, self._last_stop = self._stops + 1, str(entry.task.error)
            self._restart_ns = self._now_ns() + round(self.config.restart_after_ms * NS_PER_MS)
        else:
            self._ended = entry.task.stop_reason

    def _restart_by_itself(self, stopped: TaskEntry) -> None:
        try:
            self._restart(self._created_again(), cold=False)
        except FieldtwinError as e:  # the programs cannot be created, so the PLC stays stopped and reports why
            stopped.task.error = e
            self._ended, self._restart_ns = StopReason.FAILED, _NEVER_NS

    def restart(self, *, cold: bool = False) -> None:
        """Read the programs again and start them, with retained variables unless `cold`. Forces and a pause remain in effect.

        Raises `FileInvalid`, without any change, if the programs cannot be created (their files may have been edited).
        """
        self._restart(self._loaded(), cold=cold)
        self.sources = self._read_sources()

    def _read_sources(self) -> list[ProgramSource]:
        return sources(self.programs, self.sources, modules=self._modules)

    def _restart(self, programs: list[BoundProgram], *, cold: bool) -> None:
        paused = self.paused
        for entry in self.entries:
            entry.task.stop()
        self.retained.close()
        self.outputs.release()
        for entry in self.entries:
            entry.scan.release()
        self.starts.release()
        self._assemble(programs, cold)
        self.pause(paused)
        self.restarts += 1
        self._in_a_row += 1
        self._stopped = self._ended = None
        self._restart_ns = _NEVER_NS
        self._start_all()

    def stop(self) -> None:
        """Stop all tasks on request, and set the outputs to their safe values. A PLC that has already stopped keeps its stop
        reason.
        """
        for entry in self.entries:
            entry.task.stop()
        if self._ended is None:
            self._ended = self._stopped.task.stop_reason if self._stopped else StopReason.REQUESTED

    def close(self) -> None:
        self.retained.close()

    # -- user actions -------------------------------------------------------------------------------------------------

    @property
    def regions(self) -> Sequence[RegionLayout]:
        """Return the layouts of INPUTS and OUTPUTS."""
        return self._image.layout.regions

    @property
    def error(self) -> FieldtwinError | None:
        """Return the error because of which the PLC stopped by itself, or None."""
        return self._stopped.task.error if self._stopped else None

    @property
    def stop_reason(self) -> StopReason:
        return self._stopped.task.stop_reason if self._stopped else self._ended or StopReason.NONE

    @property
    def paused(self) -> bool:
        return any(e.task.paused for e in self.entries)

    def pause(self, on: bool) -> None:
        """Stop executing, or continue; outputs keep their values and are still published."""
        self._stepped = 0
        for entry in self.entries:
            entry.task.paused, entry.task.steps = on, 0

    def limit(self, limits: Mapping[str, tuple[float, float] | None]) -> None:
        """Set new limits for these tags in place of those in the image's layout; None: no limits. Tags that the image
        does not hold are ignored."""
        self._limits |= limits

    def as_limited(self, spec: TagSpec) -> TagSpec:
        """Return `spec` with the present limits of its tag."""
        return replace(spec, limits=self._limits[spec.name]) if spec.name in self._limits else spec

    def check_step(self) -> None:
        """Raise `UsageError` unless the PLC is paused."""
        if not self.paused:
            raise UsageError("a PLC is stepped while it is paused", hint="pause it first")

    def step(self, count: int) -> dict[str, int]:
        """Execute `count` scans of the fastest cyclic task while paused.

        Each other cyclic task executes as many scans as fall due in that time: if a task of 10 ms is stepped, a task of 100 ms
        runs in every tenth step. A SINGLE task runs when a step triggers it.

        Return the scans of each cyclic task, by its name. Raises `UsageError` unless the PLC is paused.
        """
        self.check_step()
        cyclic = [e for e in self.entries if not e.single]
        base_ms = min(e.spec.interval_ms for e in cyclic)
        before, self._stepped = self._stepped, self._stepped + count
        found = {}
        for entry in cyclic:
            cycles = entry.spec.interval_ms / base_ms
            found[entry.spec.name] = int(self._stepped / cycles + _ROUNDING) - int(before / cycles + _ROUNDING)
            entry.task.steps += found[entry.spec.name]
        return found

    @property
    def stepping(self) -> int:
        """Return the number of scans that are still to be executed while paused."""
        return sum(e.task.steps for e in self.entries) if self._stopped is None and self._ended is None else 0

    def force(
        self, tag: str, value: Scalar, by: str = "", record: Callable[[Scalar | None, Scalar], None] | None = None
    ) -> None:
        """Force a tag. Raises `UsageError` for an unknown tag, a value that it cannot hold, or one outside an output's
        limits.

        Inputs may be forced beyond their limits, so that the logic can be tested with the values of a broken sensor.
        `record` is called with the old and the new value before anything changes.
        """
        # A tag of both regions is an output that is read back: the force applies to the command.
        for region in sorted(self._image.layout.regions, key=lambda r: r.name == INPUTS):
            for spec in region.tags:
                if spec.name == tag:
                    if region.name != INPUTS:
                        _inside(self.as_limited(spec), value)
                    for program, name in self._variables_of(tag, region.name == INPUTS):
                        program.check(name, checked(spec, value))
                    if record is not None:
                        record(self._is_now(tag, region.name == INPUTS), value)
                    self.forces.force(spec, value, region.name == INPUTS, self._now_ns(), by)
                    return
        raise UsageError(f"no tag {tag!r} in the process image", expected="one that status shows")

    def _is_now(self, tag: str, inputs: bool) -> Scalar | None:
        return self.input(tag).value if inputs else self.outputs.last()[tag]

    def hidden_tags(self) -> frozenset[str]:
        """Return the tags of hidden variables, with the counters of their messages, which users do not see."""
        tags = [b.inputs[v.name].tag for b in self.programs for v in b.variables(Role.INPUT) if v.hidden]
        return frozenset(tags).union(map(consumed_name, tags))

    def _variables_of(self, tag: str, inputs: bool) -> list[tuple[Program, str]]:
        """Return the variables of programs that belong to a tag."""
        if inputs:
            return [(b.program, v) for b in self.programs for v, binding in b.inputs.items() if binding.tag == tag]
        return [(b.program, v.name) for b in self.programs for v, published in b.published() if published == tag]

    def _published(self, name: str) -> str:
        """Return the tag to which an output ``PROGRAM.VARIABLE`` is bound, and every other name unchanged."""
        return next((to for b in self.programs for v, to in b.published() if f"{b.name}.{v.name}" == name), name)

    def waits(self, tag: str) -> str:
        """Return in words the inputs and programs for which the program that writes `tag` waits; "" if it has started."""
        tag = self._published(tag)
        owner = next((b.name for b in self.programs if tag in (t for _, t in b.published())), "")
        return next((start.reason() for start in self.starts.waiting if start.name == owner), "")

    def why(self, tag: str) -> list[dict[str, Any]]:
        """Return the last changes of an output or local, the newest first. Raises `UsageError` for a tag that no
        program writes."""
        tag = self._published(tag)
        if tag not in self.outputs.last():
            what = f"no program writes {tag!r}"
            hint = did_you_mean(tag, self.outputs.last())
            if tag in self.inputs():
                what = f"{tag!r} is an input, which its device determines"
                hint = f"`fieldtwin plc watch {tag} --once` shows its value, quality and age"
            raise UsageError(what, expected="an output or local of a program", hint=hint)
        now_ns = self._now_ns()
        return [change.describe(now_ns) for change in reversed(self.outputs.changes.get(tag, ()))]

    def origin(self, tag: str, value: Scalar | None) -> tuple[str, str]:
        """Return `OutputImage.origin`, with paths inside the system's folder relative to that folder."""
        program, place = self.outputs.origin(tag, value)
        for folder in self.config.python_path:
            place = place.removeprefix(folder.rstrip("/") + "/")
        return program, place

    @property
    def halted(self) -> bool:
        """Return whether the PLC has stopped, for good or until a restart. It then reads no inputs."""
        return self._stopped is not None or self._ended is not None

    def _as_read(self, value: TagValue) -> TagValue:
        """Return the value of an input, with bad quality while the PLC is halted or stopped by a debugger."""
        if not (self.halted or self.outputs.withheld):
            return value
        return TagValue(value.value, Quality.BAD, Reason.NOT_OPERATIONAL, value.t_ns)

    def inputs(self) -> dict[str, TagValue]:
        return {tag: self._as_read(value) for tag, value in self.entries[0].scan.inputs().items()}

    def substituted_values(self, tag: str) -> dict[str, TagValue]:
        """Return `Scan.substituted_values` of all tasks."""
        if self.halted or self.outputs.withheld:  # no program reads inputs
            return {}
        return {name: seen for entry in self.entries for name, seen in entry.scan.substituted_values(tag).items()}

    def input(self, tag: str) -> TagValue:
        """Return `Scan.input` of the first task."""
        return self._as_read(self.entries[0].scan.input(tag))

    @property
    def gateway_alive(self) -> bool:
        return self.entries[0].scan.gateway_alive

    def counters(self) -> dict[str, int]:
        total: dict[str, int] = {}
        for entry in self.entries:
            for name, count in entry.scan.counters().items():
                total[name] = count if name == "mailbox_waits" else total.get(name, 0) + count
        return total

    def status(self) -> PlcStatus:
        """Return the status of the PLC, with the figures of each task. Those of the whole PLC come from the task that stopped
        it, otherwise from the first task.
        """
        now_ns = self._now_ns()
        shown = self._stopped or self.entries[0]
        described = shown.task.describe()
        if described["state"] == "running" and self.starts.waiting:
            described["state"] = "waiting"
        if described["state"] == "waiting" and (error := self.starts.error):
            described["error"] = str(error)
        return PlcStatus(
            **described,
            waiting=self.starts.waiting_statuses(now_ns),
            started_without=self.starts.started_without(),
            restarts=self.restarts,
            stops=StopsStatus(count=self._stops, last=self._last_stop),
            stepping=self.stepping,
            restart_in_ms=max(0.0, (self._restart_ns - now_ns) / 1e6) if self._restart_ns < _NEVER_NS else None,
            retain=self.retained.status(),
            forces=self.forces.describe(now_ns),
            tasks={
                e.spec.name: TaskStatus(**e.task.describe(), priority=e.spec.priority, single=e.single)
                for e in self.entries
            },
            gateway_alive=self.gateway_alive,
            counters=self.counters(),
        )


def _inside(spec: TagSpec, value: Scalar) -> None:
    if spec.limits is not None and not spec.limits[0] <= checked(spec, value) <= spec.limits[1]:  # type: ignore[operator]
        low, high = spec.limits
        raise UsageError(
            f"{spec.name} cannot be forced to that",
            expected=f"{low:g} to {high:g} {spec.unit}".strip(),
            got=repr(value),
        )


def _fitted(
    new: BoundProgram, old: BoundProgram, readers: Mapping[str, list[str]], together: dict[Any, Any]
) -> BoundProgram:
    """Return `new` with the interface of `old`, which it replaces. Raises `FileInvalid` if the image does not allow it."""
    if new.program.variables == old.program.variables:
        return new
    if not new.program.source_files:
        raise FileInvalid(
            f"program {new.name} has different variables from the running one", hint="stop the system and run it"
        )
    from fieldtwin.plc.runtime.interface import fitted  # load the compiler only for programs that need it

    made, reasons = fitted(type(new.program), old, readers)  # type: ignore[arg-type]
    if reasons:
        raise FileInvalid(f"program {new.name}: {'; '.join(reasons)}", hint="stop the system and run it again")
    return replace(new, program=made(together))
