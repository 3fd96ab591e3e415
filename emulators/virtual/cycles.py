"""The cycles that sleep in a virtual loop, and the choice of the runs that are skipped.

Runs of cycles are skipped from now until the next timer of anything else. Until then only these cycles run. If each of them would
only repeat its last run, all runs but the last one before that timer are counted instead. The last run takes place, at its own
time and in its own order among the cycles. Therefore every other part of the system finds the state, the times and the order of
timers that it would find without skipping. Only cycles with the same period are skipped together, because then each of them reads
from another one what that one published at most a period ago.
"""

from __future__ import annotations

import asyncio
from heapq import heappop, heappush
from typing import Any

from fieldtwin.gateway.core.concurrency.cycle import Cycle

Timers = list[tuple[int, int, Any]]
"""A heap of (when in ns, sequence, what is due). What is due ends with `set_result` and says with `done` that it is over."""


class CycleSleep:
    """A timer: the sleep of a cycle until its next run."""

    __slots__ = ("cycle", "done", "set_result")

    def __init__(self, future: asyncio.Future[None], cycle: Cycle) -> None:
        self.cycle = cycle
        self.done = future.done
        self.set_result = future.set_result


def skip_runs(timers: Timers) -> None:
    """Skip the runs of the cycles whose timers come first in `timers`, as far as they would change nothing.

    Their timers get later, and keep their order.
    """
    first: Timers = []
    while timers and isinstance(timers[0][2], CycleSleep) and (not first or _run_in_turn(first[0], timers[0])):
        sleep = heappop(timers)
        if not sleep[2].done():
            first.append(sleep)
    if first and timers and _is_repeated(first, timers[0][0]):
        first = [_skip(when_ns, sequence, sleep, timers[0][0]) for when_ns, sequence, sleep in first]
    for sleep in first:
        heappush(timers, sleep)


def _run_in_turn(one: tuple[int, int, CycleSleep], other: tuple[int, int, CycleSleep]) -> bool:
    """Return whether two cycles have one period and the second runs within a period of the first one.

    A later run could be at the same instant as one of the first cycle, which then has a later sequence number than it has now.
    """
    period_ns = one[2].cycle.period_ns
    return period_ns == other[2].cycle.period_ns and other[0] - one[0] < period_ns


def _is_repeated(sleeps: Timers, until_ns: int) -> bool:
    """Return whether at least one run can be skipped, and all runs before `until_ns` only repeat the last ones."""
    when_ns, _, earliest = sleeps[0]
    return when_ns + earliest.cycle.period_ns < until_ns and all(
        sleep.cycle.repeats_until(until_ns) for _, _, sleep in sleeps
    )


def _skip(when_ns: int, sequence: int, sleep: CycleSleep, until_ns: int) -> tuple[int, int, CycleSleep]:
    """Skip all runs of one cycle before `until_ns` but the last one, and return the timer of that one."""
    period_ns = sleep.cycle.period_ns
    count = (until_ns - when_ns - 1) // period_ns
    if count > 0:
        last_ns = when_ns + count * period_ns
        sleep.cycle.skip(count, last_ns - period_ns)
        return last_ns, sequence, sleep
    return when_ns, sequence, sleep
