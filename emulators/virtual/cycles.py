"""The cycles that run in a virtual loop, and the choice of the runs that are skipped.

A run that would only repeat the last one is counted in place of taking place. Runs are skipped together from now until the next
timer of anything else, because until then only cycles run. This needs cycles of one period: each of them then reads from another
one what that one published at most a period ago. Every other part of the system finds the state, the times and the order of
timers that it would find without skipping.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextvars import copy_context
from heapq import heappop, heappush
from typing import Protocol

from fieldtwin.gateway.core.concurrency.cycle import Cycle


class CycleLoop(Protocol):
    """The loop in which a cycle runs."""

    now_ns: int

    def set_cycle_timer(self, when_ns: int, call: CycleCall, /) -> None: ...


class CycleCall:
    """The call of the next run of a cycle. It has the fields of a `ScheduledCall`, and sets its own next timer.

    `ended` is done when the cycle has no further run; if it is cancelled, the cycle is not run any more. A callback takes less
    time than a task that sleeps until each run.
    """

    __slots__ = ("args", "callback", "context", "cycle", "ended", "loop", "must_run", "period_ns")

    def __init__(self, loop: CycleLoop, cycle: Cycle, ended: asyncio.Future[None]) -> None:
        self.loop = loop
        self.cycle = cycle
        self.period_ns = cycle.period_ns
        self.ended = ended
        self.callback: Callable[..., object] = self.run
        self.args: tuple[()] = ()
        self.context = copy_context()
        self.must_run = False
        """Whether `skip_runs` found that the next run may change something, so that the cycle need not be asked again."""

    @property
    def is_cancelled(self) -> bool:
        return self.ended.done()

    def run(self) -> None:
        """Run the cycle now, and set the timer of the next run. An error ends the cycle."""
        cycle, now_ns = self.cycle, self.loop.now_ns
        try:
            if not self.must_run and cycle.repeats_until(now_ns + 1):
                cycle.skip(1, now_ns)
            else:
                self.must_run = False
                while cycle.running:
                    cycle.run_once()
                    if cycle.deadline_ns > now_ns:
                        break
            if cycle.running:
                self.loop.set_cycle_timer(cycle.deadline_ns, self)
            else:
                self.ended.set_result(None)
        except BaseException as e:
            self.ended.set_exception(e)
            if isinstance(e, KeyboardInterrupt | SystemExit):
                raise


CycleTimers = list[tuple[int, int, CycleCall]]
"""A heap of (when in ns, sequence, call)."""


def skip_runs(timers: CycleTimers, until_ns: int, sequence: int) -> int:
    """Skip the runs of the cycles in `timers` before `until_ns`, as far as they would change nothing. Nothing else is due before.

    If all of these cycles only repeat their last run, all of their runs are skipped, otherwise the runs before the first one
    that has to take place. The timers of the next runs get the sequence numbers after `sequence`, in the order in which the
    runs would have set them. Return the last number.
    """
    left: CycleTimers = []
    while timers and timers[0][0] < until_ns:
        if left and not _runs_in_turn(left[0], timers[0]):
            until_ns = timers[0][0]
        else:
            timer = heappop(timers)
            if not timer[2].ended.done():
                left.append(timer)
    while left and left[-1][0] >= until_ns:
        heappush(timers, left.pop())
    repeated = 0
    for timer in left:
        if not timer[2].cycle.repeats_until(until_ns):
            timer[2].must_run = True
            break
        repeated += 1
    for timer in left[repeated:]:
        heappush(timers, timer)
    runs = _last_runs(left, until_ns) if repeated == len(left) else [(*timer, 1) for timer in left[:repeated]]
    for when_ns, _, call, count in runs:
        call.cycle.skip(count, when_ns)
        sequence += 1
        heappush(timers, (call.cycle.deadline_ns, sequence, call))
    return sequence


def _runs_in_turn(one: tuple[int, int, CycleCall], other: tuple[int, int, CycleCall]) -> bool:
    """Return whether two cycles have one period and the second runs within a period of the first one.

    A later run could be at the same instant as one of the first cycle, which then has a later sequence number than it has now.
    """
    period_ns = one[2].period_ns
    return period_ns == other[2].period_ns and other[0] - one[0] < period_ns


def _last_runs(timers: CycleTimers, until_ns: int) -> list[tuple[int, int, CycleCall, int]]:
    """Skip the runs before the last ones before `until_ns`. Return the last ones in order: their timers, and the number of runs
    of the cycle that are still to be skipped.

    The last run of a cycle is skipped after the earlier ones of the others, because it reads what they published. Nothing reads
    what the earlier runs of the first cycle publish, so they are skipped together with its last run.
    """
    last = []
    for when_ns, order, call in timers:
        earlier = (until_ns - when_ns - 1) // call.period_ns
        last.append((when_ns + earlier * call.period_ns, order, call, earlier + 1))
    last.sort()
    for place, (when_ns, order, call, count) in enumerate(last):
        if place and count > 1:
            call.cycle.skip(count - 1, when_ns - call.period_ns)
            last[place] = when_ns, order, call, 1
    return last
