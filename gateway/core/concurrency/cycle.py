"""Run a cyclic task on a clock that may skip runs which would change nothing.

In virtual time most runs of the gateway's exchange with the PLC, and most scans, only repeat the one before. A clock for
simulated time may offer ``run_cycle(cycle)``, which counts such runs in place of running them. On every other clock each run
takes place.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Protocol

from fieldtwin.gateway.core.clock import Clock


class Cycle(Protocol):
    """A task that runs at a fixed period."""

    @property
    def period_ns(self) -> int:
        """Return the time between two runs in ns."""
        ...

    @property
    def running(self) -> bool:
        """Return whether there is a further run."""
        ...

    @property
    def deadline_ns(self) -> int:
        """Return the time (monotonic ns) of the next run, while `running`."""
        ...

    def run_once(self) -> None:
        """Run once. Never waits."""
        ...

    def repeats_until(self, until_ns: int) -> bool:
        """Return whether the cycle runs, and all runs before `until_ns` would only repeat the last one, if until then only cycles
        run that also repeat themselves. Counters and times are the only things that such runs change.
        """
        ...

    def skip(self, count: int, last_ns: int) -> None:
        """Count `count` runs (at least 1) that do not take place; the last of them would have been at `last_ns`.

        Counters and times are then those that these runs would have left.
        """
        ...


async def run_cycle(clock: Clock, cycle: Cycle) -> None:
    """Run `cycle` at its deadlines until it no longer runs. The errors of a run are raised."""
    by_clock: Callable[[Cycle], Awaitable[None]] | None = getattr(clock, "run_cycle", None)
    if by_clock is not None:
        await by_clock(cycle)
        return
    while cycle.running:
        await clock.sleep_until_ns(cycle.deadline_ns)
        if cycle.running:
            cycle.run_once()
