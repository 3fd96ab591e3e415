"""The wall clock, and an event loop with precise waits. This is the only module of the gateway that imports ``time``."""

from __future__ import annotations

import asyncio
import ctypes
import os
import select
import selectors
import sys
import time
from collections.abc import Coroutine
from typing import Any, TypeVar

from fieldtwin.gateway.core.clock import NS_PER_S

T = TypeVar("T")

LEAD_NS, LEAD_SHARE = 60_000, 20
"""The time before the end of a wait at which the process wakes up: at most this many nanoseconds, and at most one 20th of the
wait.
"""


class WallClock:
    """`fieldtwin.gateway.core.clock.Clock` on the host's clocks.

    `monotonic_ns` is CLOCK_MONOTONIC, which all processes of a host share: time stamps in the process image can be
    compared between processes.
    """

    def monotonic_ns(self) -> int:
        return time.monotonic_ns()

    def utc_ns(self) -> int:
        return time.time_ns()

    async def sleep_until_ns(self, deadline_ns: int) -> None:
        while (left := deadline_ns - time.monotonic_ns()) > 0:
            await asyncio.sleep(left / NS_PER_S)


def run(main: Coroutine[Any, Any, T]) -> T:
    """Run `main` as `asyncio.run` does, on a `precise_loop`: for processes that keep the silences of a serial line."""
    with asyncio.Runner(loop_factory=precise_loop) as runner:
        return runner.run(main)


def precise_loop() -> asyncio.AbstractEventLoop:
    """Return asyncio's event loop with waits that end within some 20 us; on systems other than Linux, its usual loop.

    epoll counts in milliseconds, so asyncio is up to one millisecond late each time: a silence of 3.5 characters at
    19200 baud would take 3 ms instead of 2 ms.
    """
    selector = TimerSelector.make() if sys.platform.startswith("linux") else None
    return asyncio.SelectorEventLoop(selector)


if sys.platform.startswith("linux"):
    _TFD_FLAGS = os.O_NONBLOCK | os.O_CLOEXEC  # TFD_NONBLOCK and TFD_CLOEXEC have these values (sys/timerfd.h)

    class TimerSelector(selectors.EpollSelector):
        """A selector of epoll whose waits are ended by a timerfd (one per loop). Python 3.13 has os.timerfd_create; for
        earlier versions libc is called.
        """

        def __init__(self, descriptor: int, settime: Any) -> None:
            super().__init__()
            self._descriptor = descriptor
            self._settime = settime
            self._spec = (ctypes.c_long * 4)()  # struct itimerspec: interval, then value; seconds and nanoseconds each
            # Edge triggered: a timer that expired wakes one wait and is not read. It has no key, so it is not reported
            # to the loop.
            epoll: select.epoll = self._selector  # type: ignore[attr-defined]  # typeshed does not declare it
            epoll.register(descriptor, select.EPOLLIN | select.EPOLLET)

        @classmethod
        def make(cls) -> TimerSelector | None:
            """Return a selector, or None if the C library or a sandbox has no timerfd."""
            try:
                libc = ctypes.CDLL(None, use_errno=True)
                descriptor = libc.timerfd_create(time.CLOCK_MONOTONIC, _TFD_FLAGS)
                return cls(descriptor, libc.timerfd_settime) if descriptor >= 0 else None
            except (OSError, AttributeError):
                return None

        def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
            """Select as the base class does; a wait never ends early, and ends at most a millisecond late if the timer
            fails.

            Waking up a process takes some 50 us. So the timer expires up to `LEAD_NS` earlier, and the rest of the wait is spent
            polling the descriptors without waiting. That is at most a twentieth of a wait.
            """
            if timeout is None or timeout <= 0:
                return super().select(timeout)
            wait_ns = int(timeout * NS_PER_S) + 1
            lead_ns = min(LEAD_NS, wait_ns // LEAD_SHARE)
            due_ns = time.monotonic_ns() + wait_ns
            self._spec[2], self._spec[3] = divmod(wait_ns - lead_ns, NS_PER_S)
            self._settime(self._descriptor, 0, self._spec, None)
            ready = super().select(timeout)
            while not ready and (left_ns := due_ns - time.monotonic_ns()) > 0:
                ready = super().select(0 if left_ns <= lead_ns else left_ns / NS_PER_S)
            return ready

        def close(self) -> None:
            """Close both descriptors. Closing twice does nothing."""
            super().close()
            descriptor, self._descriptor = self._descriptor, -1
            if descriptor >= 0:
                os.close(descriptor)
