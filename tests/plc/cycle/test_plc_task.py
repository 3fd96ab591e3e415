"""The cyclic task under a manual clock: deadlines, skipped periods, watchdog, failing logic."""

from __future__ import annotations

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import eventually, run

from fieldtwin.gateway.core.errors import Bug
from fieldtwin.plc.cycle.task import CyclicTask, StopReason, TaskConfig, TaskState, run_on_clock
from fieldtwin.plc.program import ProgramFailed

MS = 1_000_000


class HandClock:
    """Time advances when a task waits, or when the test advances it. `delays_ms` makes wake-ups late."""

    def __init__(self, delays_ms: list[float] | None = None) -> None:
        self.now_ns = 1_000 * MS
        self.delays_ms = list(delays_ms or [])

    def monotonic_ns(self) -> int:
        return self.now_ns

    def utc_ns(self) -> int:
        return self.now_ns

    async def sleep_until_ns(self, deadline_ns: int) -> None:
        await asyncio.sleep(0)
        self.wake(deadline_ns)

    def wake(self, deadline_ns: int) -> None:
        late_ms = self.delays_ms.pop(0) if self.delays_ms else 0
        self.now_ns = max(self.now_ns, deadline_ns) + round(late_ms * MS)


class Logic:
    """Takes `takes_ms` of the clock's time per scan; raises on request."""

    waiting = False

    def __init__(self, clock: HandClock) -> None:
        self.clock = clock
        self.takes_ms: list[float] = []
        self.scans_ns: list[int] = []
        self.stops_ns: list[int] = []
        self.error: ProgramFailed | None = None

    def execute(self, now_ns: int) -> None:
        self.scans_ns.append(now_ns)
        if self.takes_ms:
            self.clock.now_ns += round(self.takes_ms.pop(0) * MS)
        if self.error is not None:
            raise self.error

    def stop(self, now_ns: int) -> None:
        self.stops_ns.append(now_ns)


def made(
    delays_ms: list[float] | None = None, *, late_ms: float = 5, stop_after: int = 3
) -> tuple[CyclicTask, Logic, HandClock]:
    clock = HandClock(delays_ms)
    logic = Logic(clock)
    return CyclicTask(logic, TaskConfig(10, late_ms, stop_after), clock.monotonic_ns), logic, clock


def cycles(task: CyclicTask, clock: HandClock, count: int) -> None:
    for _ in range(count):
        clock.wake(task.deadline_ns)
        task.run_once()


def starts_ms(logic: Logic) -> list[float]:
    return [ns / MS - 1_000 for ns in logic.scans_ns]


def test_deadlines_are_absolute_whatever_a_scan_takes() -> None:
    task, logic, clock = made([0, 1, 0, 4])
    logic.takes_ms = [3, 7, 1, 5]
    task.start()
    cycles(task, clock, 5)
    assert starts_ms(logic) == [10, 21, 30, 44, 50]
    assert (task.scans, task.missed_periods, task.overruns) == (5, 0, 0)
    assert task.lateness.max_ns == 4 * MS
    assert task.duration.max_ns == 7 * MS


def test_missed_periods_are_skipped_and_counted_never_burst() -> None:
    task, logic, clock = made([0, 37, 0, 0])
    task.start()
    cycles(task, clock, 4)
    assert starts_ms(logic) == [10, 57, 60, 70]
    assert (task.missed_periods, task.overruns) == (3, 1)  # 30, 40 and 50


def test_a_scan_that_is_too_long_skips_the_periods_that_it_covers() -> None:
    task, logic, clock = made()
    logic.takes_ms = [25]
    task.start()
    cycles(task, clock, 2)
    assert starts_ms(logic) == [10, 40]
    assert (task.missed_periods, task.overruns) == (2, 1)


@given(st.lists(st.tuples(st.floats(0, 100), st.floats(0, 100)), min_size=1, max_size=40))
def test_at_most_one_scan_a_period_and_every_period_is_run_or_counted(load: list[tuple[float, float]]) -> None:
    task, logic, clock = made([delay for delay, _ in load], stop_after=0)
    logic.takes_ms = [takes for _, takes in load]
    task.start()
    first_ns = task.deadline_ns
    deadlines = []
    for _ in load:
        deadlines.append(task.deadline_ns)
        cycles(task, clock, 1)
    periods = [(d - first_ns) // (10 * MS) for d in deadlines]
    assert all((d - first_ns) % (10 * MS) == 0 for d in deadlines)
    assert periods == sorted(set(periods))
    assert (task.deadline_ns - first_ns) // (10 * MS) == task.scans + task.missed_periods
    assert task.deadline_ns > clock.now_ns - 1


def test_overruns_in_a_row_stop_the_task_with_outputs_safe() -> None:
    task, logic, clock = made([6, 6, 0, 6, 6, 6])
    task.start()
    cycles(task, clock, 6)
    assert (task.state, task.stop_reason, task.overruns) == (TaskState.STOPPED, StopReason.WATCHDOG, 5)
    assert len(logic.stops_ns) == 1
    assert "3 overruns in a row" in str(task.error)
    with pytest.raises(Bug):
        task.run_once()
    task.stop()
    assert (task.stop_reason, len(logic.stops_ns)) == (StopReason.WATCHDOG, 1)


def test_stop_after_0_never_stops() -> None:
    task, _, clock = made([50] * 20, stop_after=0)
    task.start()
    cycles(task, clock, 20)
    assert (task.running, task.overruns) == (True, 20)


def test_logic_that_raises_stops_the_task_and_the_error_is_kept() -> None:
    task, logic, clock = made()
    logic.error = ProgramFailed("relay", "boom", path="relay.py", line=12)
    task.start()
    cycles(task, clock, 1)
    assert (task.state, task.stop_reason) == (TaskState.STOPPED, StopReason.FAILED)
    assert str(task.error) == "program relay, relay.py:12: boom"
    assert task.describe()["error"] == str(task.error)
    assert len(logic.stops_ns) == 1


def test_a_task_stops_on_request_and_starts_only_once() -> None:
    task, logic, _ = made()
    task.start()
    with pytest.raises(Bug):
        task.start()
    task.stop()
    assert (task.stop_reason, task.error, len(logic.stops_ns)) == (StopReason.REQUESTED, None, 1)


def test_the_same_task_runs_in_a_loop_on_any_clock_and_cancelling_makes_outputs_safe() -> None:
    async def main() -> None:
        task, logic, clock = made()
        running = asyncio.create_task(run_on_clock(task, clock))
        await eventually(lambda: task.scans >= 100)
        running.cancel()
        with pytest.raises(asyncio.CancelledError):
            await running
        assert starts_ms(logic)[:100] == [10.0 * n for n in range(1, 101)]
        assert (task.stop_reason, len(logic.stops_ns)) == (StopReason.REQUESTED, 1)

    run(main())
