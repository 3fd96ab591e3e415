"""The cyclic task: it runs a scan at absolute deadlines, and measures its lateness. A watchdog stops it.

Deadlines are start + k x cycle and never move. A task that is late runs once and continues with the next deadline in
the future: missed periods are skipped and counted, and not made up for in a burst.

    READY --start--> RUNNING --stop------------------------------> STOPPED (requested)
                        | ---inputs missing, policy is stop------> STOPPED (not started; fieldtwin.plc.cycle.start)
                        | ---`stop_after` overruns in a row------> STOPPED (watchdog)
                        | ---a program raises an error-----------> STOPPED (failed; `error` has the place)
                        | ---a scan does not end-----------------> STOPPED (stuck; `error` has the place)
                        | ---a `trip` input becomes bad----------> STOPPED (tripped)

On every path to STOPPED the outputs are published as stopped, which makes the gateway write their safe values. The task itself
does not wait: its driver sleeps until `deadline_ns` and calls `run_once`. So the same object runs on the wall clock
(fieldtwin.plc.runtime.realtime) and in a loop under virtual time (`run_on_clock`). It must not depend on which of the two
drives it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

from fieldtwin.gateway.core.clock import NS_PER_MS, Clock
from fieldtwin.gateway.core.concurrency.cycle import Cycle, run_cycle
from fieldtwin.gateway.core.errors import Bug, CheckFailed, FieldtwinError
from fieldtwin.gateway.core.histogram import Histogram
from fieldtwin.plc.program import InputTripped, ProgramStuck, ScanStuck


class Executable(Protocol):
    """The interface of the object that a task runs. `fieldtwin.plc.cycle.scan.Scan` implements it."""

    def execute(self, now_ns: int) -> None: ...

    def hold(self, now_ns: int) -> None: ...

    def stop(self, now_ns: int) -> None: ...

    def repeats_until(self, until_ns: int) -> bool: ...

    def skip(self, count: int, last_ns: int) -> None: ...

    @property
    def waiting(self) -> bool: ...


class Guard(Protocol):
    """The interface of a guard against a scan that never ends. It is armed before each scan and disarmed after it."""

    def arm(self) -> None: ...

    def disarm(self) -> None: ...


class Driven(Cycle, Protocol):
    """The interface through which a clock runs one task (`CyclicTask`) or several (`fieldtwin.plc.runtime.runner.TaskRunner`)."""

    def start(self) -> None: ...

    def stop(self) -> None: ...


class TaskState(Enum):
    READY = "ready"
    RUNNING = "running"
    STOPPED = "stopped"


_RUNNING = TaskState.RUNNING  # a local name, because looking up an Enum's members is slow


class StopReason(Enum):
    NONE = "none"
    REQUESTED = "requested"
    WATCHDOG = "watchdog"
    FAILED = "failed"
    STUCK = "stuck"
    TRIPPED = "tripped"
    NOT_STARTED = "not started"


@dataclass(frozen=True, slots=True)
class TaskConfig:
    """The configuration of a task. `cycle_ms` is the time between deadlines. A scan that starts more than `late_ms` after its
    deadline, or ends after the next one, is an overrun, and `stop_after` overruns in a row stop the task (0: never). `name` is
    the task's name in messages.
    """

    cycle_ms: float
    late_ms: float = 5.0
    stop_after: int = 3
    name: str = "main"

    def __post_init__(self) -> None:
        if not (self.cycle_ms > 0 and self.late_ms > 0 and self.stop_after >= 0):
            raise Bug(
                "an impossible task", expected="cycle_ms and late_ms above 0, stop_after 0 or more", got=str(self)
            )


class CyclicTask:
    """A task that runs one scan cyclically. `now_ns` returns the clock's monotonic time.

    `lateness` is a histogram of the delays of a scan's start after its deadline, `duration` one of execution times. The counters
    are `scans`, `missed_periods` and `overruns`.
    """

    def __init__(
        self, scan: Executable, config: TaskConfig, now_ns: Callable[[], int], guard: Guard | None = None
    ) -> None:
        self.config = config
        self.paused = False
        """While paused, each deadline publishes the outputs instead of running the logic, except for `steps` scans. The
        same applies while none of the task's programs has started."""
        self.steps = 0
        self.held_up_by = ""
        """A description of the task that was still running when this one became due, for messages. A runner of several tasks
        sets it; empty if there was none.
        """
        self.excused = False
        """Whether the next scan does not count as an overrun, because a debugger has stopped a scan."""
        self.began_ns = 0
        """The time (monotonic ns) at which the last scan began."""
        self.ended_ns = 0
        """The time (monotonic ns) at which the last scan ended."""
        self._guard = guard
        self.state = TaskState.READY
        self.stop_reason = StopReason.NONE
        self.error: FieldtwinError | None = None
        self.lateness = Histogram()
        self.duration = Histogram()
        self.scans = self.missed_periods = self.overruns = 0
        self.deadline_ns = 0
        """The time (monotonic ns) at which the next scan is due; valid while RUNNING."""
        self._scan = scan
        self._now_ns = now_ns
        self._cycle_ns = round(config.cycle_ms * NS_PER_MS)
        self._late_ns = round(config.late_ms * NS_PER_MS)
        self._overruns_in_a_row = 0

    @property
    def running(self) -> bool:
        return self.state is _RUNNING

    def start(self) -> None:
        """Change the state from READY to RUNNING. The first scan is due one cycle from now."""
        if self.state is not TaskState.READY:
            raise Bug("a task is started once", got=self.state.value)
        self.state = TaskState.RUNNING
        self.deadline_ns = self._now_ns() + self._cycle_ns

    def run_once(self) -> None:
        """Run the scan that is due. Afterwards `deadline_ns` is the next deadline, or the state is STOPPED."""
        if self.state is not _RUNNING:
            raise Bug("a scan of a task that does not run", got=self.state.value)
        began_ns = self.began_ns = self._now_ns()
        late_ns = began_ns - self.deadline_ns
        if (self.paused and not self.steps) or self._scan.waiting:
            self._scan.hold(began_ns)
            self.deadline_ns += ((began_ns - self.deadline_ns) // self._cycle_ns + 1) * self._cycle_ns
            return
        if self.steps:
            self.steps -= 1
        self.lateness.record(late_ns)
        try:
            if self._guard is None:
                self._scan.execute(began_ns)
            else:
                self._guarded(self._guard, began_ns)
        except FieldtwinError as e:
            self.error = e
            stuck, tripped = isinstance(e, ProgramStuck), isinstance(e, InputTripped)
            self._stop(StopReason.STUCK if stuck else StopReason.TRIPPED if tripped else StopReason.FAILED)
            return
        self.scans += 1
        ended_ns = self.ended_ns = self._now_ns()
        if not self.excused:
            self.duration.record(ended_ns - began_ns)
        due_ns = self.deadline_ns = self.deadline_ns + self._cycle_ns
        missed = 0
        if ended_ns >= due_ns:
            missed = (ended_ns - due_ns) // self._cycle_ns + 1
            self.missed_periods += missed
            self.deadline_ns += missed * self._cycle_ns
        if self.excused:
            self.excused, self._overruns_in_a_row = False, 0
        elif missed or late_ns > self._late_ns:
            self._overrun(late_ns, ended_ns - began_ns)
        else:
            self._overruns_in_a_row = 0

    @property
    def period_ns(self) -> int:
        return self._cycle_ns

    def repeats_until(self, until_ns: int) -> bool:
        """Return whether every scan before `until_ns` would only repeat the last one, see `Cycle`."""
        return self.state is _RUNNING and not self.paused and self._scan.repeats_until(until_ns)

    def skip(self, count: int, last_ns: int) -> None:
        """Count scans that do not take place, see `Cycle`. They would have been punctual, and would have taken no time."""
        self._scan.skip(count, last_ns)
        self._overruns_in_a_row = 0
        self.scans += count
        self.ended_ns = last_ns
        self.deadline_ns += count * self._cycle_ns
        self.lateness.record_zeros(count)
        self.duration.record_zeros(count)

    def _guarded(self, guard: Guard, now_ns: int) -> None:
        try:
            guard.arm()
            try:
                self._scan.execute(now_ns)
            finally:
                guard.disarm()
        except ScanStuck as e:  # between two programs
            guard.disarm()  # the timer may have expired while it was being disarmed
            raise ProgramStuck("(all)", f"the scan did not end: {e}") from e

    def stop(self) -> None:
        """Stop on request, and set the outputs to their safe values. A task that has already stopped is not changed."""
        if self.state is not TaskState.STOPPED:
            self._stop(StopReason.REQUESTED)

    def fail(self, error: FieldtwinError, reason: StopReason) -> None:
        """Stop because of `error`, which occurred outside of a scan."""
        self.error = error
        self._stop(reason)

    def _overrun(self, late_ns: int, took_ns: int) -> None:
        self.overruns += 1
        self._overruns_in_a_row += 1
        if self.config.stop_after and self._overruns_in_a_row >= self.config.stop_after:
            config = self.config
            late = f"{max(0, late_ns) / 1e6:.3f} ms late" + (
                f" because {self.held_up_by} ran" if self.held_up_by else ""
            )
            self.error = CheckFailed(
                f"the watchdog stopped task {config.name}",
                expected=f"a scan every {config.cycle_ms:g} ms, at most {config.late_ms:g} ms late",
                got=f"{self._overruns_in_a_row} overruns in a row; the last scan began {late}, and took {took_ns / 1e6:.3f} ms",
            )
            self._stop(StopReason.WATCHDOG)

    def _stop(self, reason: StopReason) -> None:
        self.state = TaskState.STOPPED
        self.stop_reason = reason
        self._scan.stop(self._now_ns())

    def describe(self) -> dict[str, Any]:
        """Return state, reason, error, counters, and lateness and duration in microseconds, as data for JSON."""
        state = self.state.value
        if self.running and (self.paused or self._scan.waiting):
            state = "paused" if self.paused else "waiting"
        return {
            "state": state,
            "stop_reason": self.stop_reason.value,
            "error": str(self.error) if self.error else "",
            "error_at": getattr(self.error, "place", ""),
            "cycle_ms": self.config.cycle_ms,
            "late_ms": self.config.late_ms,
            "scans": self.scans,
            "missed_periods": self.missed_periods,
            "overruns": self.overruns,
            "lateness_us": self.lateness.summary_us(),
            "duration_us": self.duration.summary_us(),
        }


async def run_on_clock(task: Driven, clock: Clock) -> None:
    """Run `task` in the running event loop, on `clock`, until the task is stopped. Cancelling sets its outputs to their safe
    values.
    """
    task.start()
    try:
        await run_cycle(clock, task)
    finally:
        task.stop()
