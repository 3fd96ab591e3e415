"""The wall clock: the only place on the gateway's side that imports ``time``."""

from __future__ import annotations

import asyncio
import time

from gateway.core.clock import NS_PER_S


class WallClock:
    """`gateway.core.clock.Clock` on the host's clocks.

    `monotonic_ns` is CLOCK_MONOTONIC, which every process of a host shares: time stamps in the process image can be
    compared across processes.
    """

    def monotonic_ns(self) -> int:
        return time.monotonic_ns()

    def utc_ns(self) -> int:
        return time.time_ns()

    async def sleep_until_ns(self, deadline_ns: int) -> None:
        while (left := deadline_ns - time.monotonic_ns()) > 0:
            await asyncio.sleep(left / NS_PER_S)
