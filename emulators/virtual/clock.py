"""The clock of a virtual loop; it implements `fieldtwin.gateway.core.clock.Clock`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from operator import attrgetter

from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.concurrency.cycle import Cycle

EPOCH_UTC_NS = 1_767_225_600 * NS_PER_S
"""2026-01-01T00:00:00Z: the start of every virtual run, so that the times in its trace are reproducible."""


class VirtualClock:
    """A clock whose monotonic time is that of the loop. UTC starts at `EPOCH_UTC_NS` and advances with the loop."""

    def __init__(self, loop: VirtualLoop, epoch_utc_ns: int = EPOCH_UTC_NS) -> None:
        self._loop = loop
        self.monotonic_ns: Callable[[], int] = partial(attrgetter("now_ns"), loop)
        """A function that returns the loop's time. It is not a method, because it is called 5 to 45 times per scan, and a
        method takes longer.
        """
        self._offset_ns = epoch_utc_ns - loop.now_ns

    def utc_ns(self) -> int:
        return self._loop.now_ns + self._offset_ns

    async def sleep_until_ns(self, deadline_ns: int) -> None:
        if deadline_ns <= self._loop.now_ns:
            return
        await self._loop.sleeper(deadline_ns)

    async def run_cycle(self, cycle: Cycle) -> None:
        """Run `cycle` at its deadlines; see `fieldtwin.gateway.core.concurrency.cycle`."""
        await self._loop.run_cycle(cycle)
