"""A wait of a task until a given time, which another task can end earlier."""

from __future__ import annotations

import asyncio

from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.concurrency.timeout import ring, start_timeout


class Wakeup:
    """The sleep of one task, which calls `reset`, checks for work and calls `sleep`; a `wake` after `reset` ends the sleep."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._awake = False
        self._sleeper: asyncio.Future[None] | None = None

    def reset(self) -> None:
        """Ignore earlier calls of `wake`."""
        self._awake = False

    def wake(self) -> None:
        """End the sleep, or the next one if the task does not sleep now."""
        self._awake = True
        if self._sleeper is not None:
            ring(self._sleeper)

    async def sleep(self, until_ns: int | None) -> None:
        """Sleep until `until_ns` (monotonic), or until `wake` is called; with None, only until `wake` is called."""
        if self._awake:
            return
        loop, end = asyncio.get_running_loop(), None
        if until_ns is None:
            self._sleeper = loop.create_future()
        else:
            left_s = (until_ns - self._clock.monotonic_ns()) / NS_PER_S
            self._sleeper, end = start_timeout(loop, left_s if left_s > 0.0 else 0.0)
        try:
            await self._sleeper
        finally:
            self._sleeper = None
            if end is not None:
                end()
