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
from typing import Any, Protocol

from fieldtwin.gateway.core.concurrency.cycle import Cycle

Timers = list[tuple[int, int, Any]]
"""A heap of (when in ns, sequence, what is due)."""


class CycleLoop(Protocol):
    """The loop in which a cycle runs."""

    now_ns: int

    def set_timer(self, when_ns: int, due: CycleCall, /) -> None: ...


class CycleCall:
    """The call of the next run of a cycle. It has the fields of a `ScheduledCall`, and sets its own next timer.

    `ended` is done when the cycle has no further run; if it is cancelled, the cycle is not run any more. A callback takes less
    time than a task that sleeps until each run.
    """

    __slots__ = ("args", "callback", "context", "cycle", "ended", "loop", "period_ns")

    def __init__(self, loop: CycleLoop, cycle: Cycle, ended: asyncio.Future[None]) -> None:
        self.loop = loop
        self.cycle = cycle
        self.period_ns = cycle.period_ns
        self.ended = ended
        self.callback: Callable[..., object] = self.run
        self.args: tuple[()] = ()
        self.context = copy_context()

    @property
    def is_cancelled(self) -> bool:
        return self.ended.done()

    def run(self) -> None:
        """Run the cycle now, and set the timer of the next run. An error ends the cycle."""
        cycle, now_ns = self.cycle, self.loop.now_ns
        try:
            if cycle.repeats_until(now_ns + 1):
                cycle.skip(1, now_ns)
            else:
                while cycle.running:
                    cycle.run_once()
                    if cycle.deadline_ns > now_ns:
                        break
            if cycle.running:
                self.loop.set_timer(cycle.deadline_ns, self)
            else:
                self.ended.set_result(None)
        except BaseException as e:
            self.ended.set_exception(e)
            if isinstance(e, KeyboardInterrupt | SystemExit):
                raise


def skip_runs(timers: Timers, sequence: int) -> int:
    """Skip the runs of the cycles whose timers come first in `timers`, as far as they would change nothing.

    If all of them only repeat their last run, their runs until the next timer of anything else are skipped, otherwise the runs
    before the first one that has to take place. The timers of the next runs get the sequence numbers after `sequence`, in the
    order in which the runs would have set them. Return the last number.
    """
    left: Timers = []
    while timers and type(timers[0][2]) is CycleCall and (not left or _runs_in_turn(left[0], timers[0])):
        timer = heappop(timers)
        if not timer[2].ended.done():
            left.append(timer)
    if left and timers and left[0][0] < timers[0][0]:
        until_ns = timers[0][0]
        repeated: Timers = []
        for timer in left:
            if not timer[2].cycle.repeats_until(until_ns):
                break
            repeated.append(timer)
        all_repeat = len(repeated) == len(left)
        left = left[len(repeated) :]
        for when_ns, order, call, count in _last_runs(repeated, until_ns) if all_repeat else _next_runs(repeated):
            if when_ns < until_ns:
                call.cycle.skip(count, when_ns)
                sequence += 1
                heappush(timers, (call.cycle.deadline_ns, sequence, call))
            else:
                heappush(timers, (when_ns, order, call))
    for timer in left:
        heappush(timers, timer)
    return sequence


def _runs_in_turn(one: tuple[int, int, CycleCall], other: tuple[int, int, CycleCall]) -> bool:
    """Return whether two cycles have one period and the second runs within a period of the first one.

    A later run could be at the same instant as one of the first cycle, which then has a later sequence number than it has now.
    """
    period_ns = one[2].period_ns
    return period_ns == other[2].period_ns and other[0] - one[0] < period_ns


def _next_runs(timers: Timers) -> list[tuple[int, int, CycleCall, int]]:
    """Return the next run of each cycle: its timer, and 1."""
    return [(*timer, 1) for timer in timers]


def _last_runs(timers: Timers, until_ns: int) -> list[tuple[int, int, CycleCall, int]]:
    """Skip the runs before the last ones before `until_ns`. Return the last ones in order: their timers, and the number of runs
    of the cycle that are still to be skipped.

    The last run of a cycle is skipped after the earlier ones of the others, because it reads what they published. Nothing reads
    what the earlier runs of the first cycle publish, so they are skipped together with its last run.
    """
    last = []
    for when_ns, order, call in timers:
        earlier = max(0, (until_ns - when_ns - 1) // call.period_ns)
        last.append((when_ns + earlier * call.period_ns, order, call, earlier + 1))
    last.sort()
    for place, (when_ns, order, call, count) in enumerate(last):
        if place and count > 1:
            call.cycle.skip(count - 1, when_ns - call.period_ns)
            last[place] = when_ns, order, call, 1
    return last
