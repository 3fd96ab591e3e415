"""Wait for the next run of a cyclic task, on a clock that may skip runs which would change nothing.

In virtual time most runs of the gateway's exchange with the PLC, and most scans, only repeat the one before. A clock for
simulated time knows when the next other event is due, so it may offer ``sleep_cycle_ns(deadline_ns, cycle)`` and count such
runs in place of running them. On every other clock each run takes place.
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

    def repeats_until(self, until_ns: int) -> bool:
        """Return whether all runs before `until_ns` would only repeat the last one, if nothing but cycles that also repeat runs
        until then. Counters and times are the only things that such runs change.
        """
        ...

    def skip(self, count: int, last_ns: int) -> None:
        """Count `count` runs (at least 1) that do not take place; the last of them would have been at `last_ns`.

        At least one run follows before anything else happens. Only counters, and what other cycles read, need to change.
        """
        ...


def sleep_cycle(clock: Clock, deadline_ns: int, cycle: Cycle) -> Awaitable[None]:
    """Wait until the next run of `cycle`, which is at `deadline_ns` unless the clock skips runs."""
    sleep: Callable[[int, Cycle], Awaitable[None]] | None = getattr(clock, "sleep_cycle_ns", None)
    return clock.sleep_until_ns(deadline_ns) if sleep is None else sleep(deadline_ns, cycle)
