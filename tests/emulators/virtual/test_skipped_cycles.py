"""Skipped runs of cycles: a run in virtual time reports the same with and without them, and their order is kept."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.concurrency.cycle import run_cycle
from fieldtwin.plc.runtime.runner import TaskRunner
from fieldtwin.run.virtual.fault_schedule import RandomFaults
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun

MS = 1_000_000


@dataclass
class Counting:
    """A cycle that counts its runs, and reads how often the `others` have run. It repeats itself unless there is news."""

    name: str
    log: list[tuple[str, int, int]]
    period_ns: int
    deadline_ns: int
    running: bool = True
    news: int = 0
    seen: int = 0
    runs: int = 0
    skipped: int = 0
    read: int = 0
    others: list[Counting] = field(default_factory=list)

    def run_once(self) -> None:
        if self.seen != self.news:
            self.log.append((self.name, self.deadline_ns, self.news))
        self.seen = self.news
        self._count(1)

    def repeats_until(self, until_ns: int) -> bool:
        return self.seen == self.news

    def skip(self, count: int, last_ns: int) -> None:
        assert last_ns == self.deadline_ns + (count - 1) * self.period_ns
        self.skipped += count
        self._count(count)

    def _count(self, count: int) -> None:
        self.runs += count
        self.deadline_ns += count * self.period_ns
        self.read = sum(cycle.runs for cycle in self.others)


def log_of(phases: list[int], periods: list[int], events: list[int], *, skips: bool) -> tuple[list[object], int]:
    """Run cycles and events; return all that they saw, with the numbers of runs, and how many runs were skipped."""
    loop = VirtualLoop(0)
    clock = VirtualClock(loop)
    log: list[tuple[str, int, int]] = []
    end_ns = 1000 * MS
    cycles = [
        Counting(f"c{n}", log, period * MS, phase * MS)
        for n, (period, phase) in enumerate(zip(periods, phases, strict=False))
    ]
    for cycle in cycles:
        cycle.others = cycles

    def happen(n: int) -> None:
        for cycle in cycles[n % len(cycles) :]:  # the other cycles would only repeat themselves
            cycle.news += 1
        log.append((f"event {[(cycle.runs, cycle.read) for cycle in cycles]}", loop.now_ns, n))

    async def main() -> None:
        tasks = [loop.create_task(run_cycle(clock, cycle)) for cycle in cycles]
        for n, at_ms in enumerate(events):
            loop.call_at_ns(at_ms * MS, happen, n)
        loop.call_at_ns(end_ns, happen, len(events))
        await clock.sleep_until_ns(end_ns)
        for task in tasks:
            task.cancel()

    if not skips:
        clock.run_cycle = None  # type: ignore[assignment, method-assign]  # as a clock that offers no skipping
    loop.run_until_complete(main())
    return [*log, *(cycle.runs for cycle in cycles)], sum(cycle.skipped for cycle in cycles)


@given(
    phases=st.lists(st.integers(1, 30), min_size=3, max_size=3),
    periods=st.lists(st.sampled_from([10, 20]), min_size=1, max_size=3),
    events=st.lists(st.integers(0, 999), max_size=20),
)
@example([1, 1, 21], [10, 10, 10], [22])  # the third cycle begins at a run of the others, two periods later
def test_every_event_and_cycle_sees_the_same_with_and_without_skipped_runs(
    phases: list[int], periods: list[int], events: list[int]
) -> None:
    with_skips, _ = log_of(phases, periods, events, skips=True)
    without, none = log_of(phases, periods, events, skips=False)
    assert with_skips == without
    assert none == 0


def test_runs_between_two_distant_events_are_skipped() -> None:
    _, skipped = log_of([10, 10], [10, 10], [5, 505], skips=True)
    assert skipped > 150


@pytest.mark.parametrize("skips", [True, False])
def test_an_error_of_a_run_is_raised_and_a_cancelled_cycle_runs_no_more(skips: bool) -> None:
    loop = VirtualLoop(0)
    clock = VirtualClock(loop)
    if not skips:
        clock.run_cycle = None  # type: ignore[assignment, method-assign]

    class Failing(Counting):
        def run_once(self) -> None:
            super().run_once()
            self.news += 1  # so that no run is skipped
            if self.runs == 3:
                raise ValueError("third run")

    async def main() -> None:
        failing = Failing("f", [], 10 * MS, 5 * MS, news=1)
        with pytest.raises(ValueError, match="third run"):
            await run_cycle(clock, failing)
        assert loop.now_ns == 25 * MS
        cancelled = Failing("c", [], 10 * MS, loop.now_ns, news=1)
        task = loop.create_task(run_cycle(clock, cancelled))
        await clock.sleep_until_ns(loop.now_ns + 15 * MS)
        task.cancel()
        await clock.sleep_until_ns(loop.now_ns + 50 * MS)
        assert (cancelled.runs, failing.runs) == (2, 3)

    loop.run_until_complete(main())


def report_of(system: str, seed: int, seconds: float, faults: RandomFaults | None) -> tuple[object, ...]:
    run = VirtualRun(VirtualOptions(system, seconds, seed=seed, random_faults=faults))
    run.run()
    statuses = [
        repr((c.gateway_status, c.plc_status, c.field_status, c.oracle.describe())) for c in run.checks.values()
    ]
    return run.summary(), *statuses


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 4])
@pytest.mark.parametrize("faults", [None, RandomFaults(mean_s=5.0)])
def test_a_run_reports_the_same_with_and_without_skipped_runs(
    seed: int, faults: RandomFaults | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts: list[int] = []
    skip = TaskRunner.skip

    def counted(self: TaskRunner, count: int, last_ns: int) -> None:
        counts.append(count)
        skip(self, count, last_ns)

    monkeypatch.setattr(TaskRunner, "skip", counted)
    seconds = 150.0 if faults else 20.0  # random faults end two minutes before the end
    with_skips = report_of("observatory", seed, seconds, faults)
    assert sum(counts) > 100
    monkeypatch.delattr(VirtualClock, "run_cycle")
    assert report_of("observatory", seed, seconds, faults) == with_skips
