"""Skipped runs of cycles: a run in virtual time reports the same with and without them, and their order is kept."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.concurrency.cycle import sleep_cycle
from fieldtwin.plc.runtime.runner import TaskRunner
from fieldtwin.run.virtual.fault_schedule import RandomFaults
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun

MS = 1_000_000


@dataclass
class Counting:
    """A cycle that counts its runs, and reads how often the `others` have run. It repeats itself unless there is news."""

    name: str
    log: list[tuple[str, int, int]]
    period_ns: int = 10 * MS
    news: int = 0
    seen: int = 0
    runs: int = 0
    skipped: int = 0
    next_ns: int = 0
    read: int = 0
    others: list[Counting] = field(default_factory=list)

    def repeats_until(self, until_ns: int) -> bool:
        return self.seen == self.news

    def skip(self, count: int, last_ns: int) -> None:
        assert last_ns == self.next_ns + (count - 1) * self.period_ns
        self.runs += count
        self.skipped += count
        self.next_ns += count * self.period_ns

    async def run(self, clock: VirtualClock, first_ns: int, end_ns: int) -> None:
        self.next_ns = first_ns
        while self.next_ns < end_ns:
            await sleep_cycle(clock, self.next_ns, self)
            self.runs += 1
            self.read = sum(cycle.runs for cycle in self.others)
            if self.seen != self.news:
                self.log.append((self.name, clock.monotonic_ns(), self.news))
            self.seen = self.news
            self.next_ns += self.period_ns


def log_of(phases: list[int], periods: list[int], events: list[int], *, skips: bool) -> tuple[list[object], int]:
    """Run cycles and events; return all that they saw, with the numbers of runs, and how many runs were skipped."""
    loop = VirtualLoop(0)
    clock = VirtualClock(loop)
    log: list[tuple[str, int, int]] = []
    cycles = [Counting(f"c{n}", log, period * MS) for n, period in enumerate(periods)]
    for cycle in cycles:
        cycle.others = cycles
    end_ns = 1000 * MS

    def happen(n: int) -> None:
        for cycle in cycles:
            cycle.news += 1
        log.append((f"event {[(cycle.runs, cycle.read) for cycle in cycles]}", loop.now_ns, n))

    async def main() -> None:
        tasks = [
            loop.create_task(cycle.run(clock, phase * MS, end_ns)) for cycle, phase in zip(cycles, phases, strict=False)
        ]
        for n, at_ms in enumerate(events):
            loop.call_at_ns(at_ms * MS, happen, n)
        loop.call_at_ns(end_ns, happen, len(events))
        for task in tasks:
            await task

    if not skips:
        clock.sleep_cycle_ns = None  # type: ignore[assignment, method-assign]  # as a clock that offers no skipping
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
    monkeypatch.delattr(VirtualClock, "sleep_cycle_ns")
    assert report_of("observatory", seed, seconds, faults) == with_skips
