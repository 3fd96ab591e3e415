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

    __slots__ = ("args", "callback", "context", "cycle", "ended", "loop")

    def __init__(self, loop: CycleLoop, cycle: Cycle, ended: asyncio.Future[None]) -> None:
        self.loop = loop
        self.cycle = cycle
        self.ended = ended
        self.callback: Callable[..., object] = self.run
        self.args: tuple[()] = ()
        self.context = copy_context()

    @property
    def is_cancelled(self) -> bool:
        return self.ended.done()

    def run(self) -> None:
        """Run the cycle now, and set the timer of the next run. An error ends the cycle."""
        cycle, loop = self.cycle, self.loop
        now_ns = loop.now_ns
        try:
            while cycle.running:
                if cycle.deadline_ns == now_ns and cycle.repeats_until(now_ns + 1):
                    cycle.skip(1, now_ns)
                else:
                    cycle.run_once()
                if cycle.running and cycle.deadline_ns > now_ns:
                    loop.set_timer(cycle.deadline_ns, self)
                    return
        except BaseException as e:
            self.ended.set_exception(e)
            if isinstance(e, KeyboardInterrupt | SystemExit):
                raise
        else:
            self.ended.set_result(None)


def skip_runs(timers: Timers, sequence: int) -> int:
    """Skip the runs of the cycles whose timers come first in `timers`, until the next timer of anything else, if all of them
    would change nothing.

    The timers of the next runs get the sequence numbers after `sequence`, in the order in which the runs would have set them.
    Return the last number.
    """
    first: Timers = []
    while timers and type(timers[0][2]) is CycleCall and (not first or _run_in_turn(first[0], timers[0])):
        timer = heappop(timers)
        if not timer[2].is_cancelled:
            first.append(timer)
    if first and timers and first[0][0] < timers[0][0] and _are_repeated(first, timers[0][0]):
        sequence = _skip(first, timers[0][0], sequence)
    for timer in first:
        heappush(timers, timer)
    return sequence


def _run_in_turn(one: tuple[int, int, CycleCall], other: tuple[int, int, CycleCall]) -> bool:
    """Return whether two cycles have one period and the second runs within a period of the first one.

    A later run could be at the same instant as one of the first cycle, which then has a later sequence number than it has now.
    """
    period_ns = one[2].cycle.period_ns
    return period_ns == other[2].cycle.period_ns and other[0] - one[0] < period_ns


def _are_repeated(calls: Timers, until_ns: int) -> bool:
    """Return whether all runs before `until_ns` only repeat the last ones."""
    return all(call.cycle.repeats_until(until_ns) for _, _, call in calls)


def _skip(calls: Timers, until_ns: int, sequence: int) -> int:
    """Skip all runs before `until_ns`, and replace `calls` by the timers of the next runs. Return the last sequence number.

    The last run of each cycle is skipped after the earlier ones of all cycles, because it reads what they published.
    """
    last: Timers = []
    for when_ns, order, call in calls:
        period_ns = call.cycle.period_ns
        earlier = (until_ns - when_ns - 1) // period_ns  # -1 if there is no run before `until_ns`
        if earlier > 0:
            call.cycle.skip(earlier, when_ns + (earlier - 1) * period_ns)
        last.append((when_ns + earlier * period_ns if earlier >= 0 else when_ns, order, call))
    calls.clear()
    for when_ns, order, call in sorted(last):
        if when_ns < until_ns:
            call.cycle.skip(1, when_ns)
            sequence += 1
            calls.append((call.cycle.deadline_ns, sequence, call))
        else:
            calls.append((when_ns, order, call))
    return sequence
