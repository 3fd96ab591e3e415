"""The wall clock of a PLC process: precise sleeping, and the requests to the operating system that it needs.

One thread does all the work. Between two scans it runs the control channel's asyncio loop, but only until `GUARD_NS`
before the next deadline (asyncio rounds its timers up to 1 ms). The rest of the wait is an absolute clock_nanosleep,
and the thread spins through the last `LEAD_NS`. The alternative was a second thread for the channel. It would hold the
interpreter's lock at unpredictable times, for up to the length of a JSON encoding, whereas here a request is begun only
while there is slack. In cycles too short for the guard, the channel is polled without waiting, every `POLL_NS`.

Both were measured at a 10 ms cycle with a `get` every 20 ms, on 2 cores shared with other work (load 4 to 7), 10 s per
run, three runs each in the order ABBAAB; lateness of the scan's start, p50 / p99:

    SCHED_FIFO    one thread 46 to 58 us / 0.13 to 0.20 ms     two threads 84 to 88 us / 0.43 to 1.1 ms
    SCHED_OTHER   one thread 410 to 852 us / 8.9 to 15 ms      two threads 94 to 450 us / 8.3 to 41 ms

So under SCHED_FIFO one thread is better in every run. In the normal class on a busy host it is not: its median was
worse, the tails overlap, and four earlier runs of 20 s in a fixed order favoured the second thread; the cause was not
investigated. SCHED_FIFO is requested by default. One run of 20 s each, on the same host while its load rose from 0.7 to
4, with ten `get` per second: 10 ms cycle 74 us / 1.1 ms, with SCHED_FIFO 49 us / 96 us; 1 ms cycle 39 us / 6.4 ms and
24 % of periods missed, with SCHED_FIFO 39 us / 188 us and 0.5 % missed.

This is the only module of the PLC that imports ``time``.
"""

from __future__ import annotations

import asyncio
import ctypes
import errno
import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.plc.cycle.task import Driven
from fieldtwin.plc.program import ScanStuck
from fieldtwin.plc.status import RealtimeStatus

GUARD_NS = 2 * NS_PER_MS
POLL_NS = 10 * NS_PER_MS
LEAD_NS, LEAD_SHARE = 60_000, 20
"""How long before a deadline the process is woken, so that it is awake in time: an idle processor needs some 50 us to
wake up. The process spins meanwhile, for at most a twentieth of the time that it slept."""
SWITCH_S = 0.0002
"""The longest time (s) for which a thread next to the scans keeps the interpreter's lock while a scan is due."""
STEP_NS = 200 * NS_PER_MS
"""The longest time (ns) for which the process waits without checking whether it has to stop."""

_CLOCK_MONOTONIC = 1
_TIMER_ABSTIME = 1
_PR_SET_TIMERSLACK = 29
_MCL_CURRENT, _MCL_FUTURE = 1, 2


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


_libc: Any = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None


def monotonic_ns() -> int:
    """Return the host's monotonic time, which is the same for every process."""
    return time.monotonic_ns()


def utc_ns() -> int:
    """Return the host's UTC in ns since 1970, for records and displays; it is not used for timing."""
    return time.time_ns()


def sleep_until_ns(deadline_ns: int) -> None:
    """Wait until `monotonic_ns` has reached `deadline_ns`; return earlier only when a signal arrived."""
    if _libc is None:
        time.sleep(max(0, deadline_ns - time.monotonic_ns()) / NS_PER_S)
        return
    until = _Timespec(deadline_ns // NS_PER_S, deadline_ns % NS_PER_S)
    _libc.clock_nanosleep(_CLOCK_MONOTONIC, _TIMER_ABSTIME, ctypes.byref(until), None)


@dataclass(frozen=True, slots=True)
class RealtimeReport:
    """The real-time measures that the host granted, and those that it refused, with the reason."""

    granted: tuple[str, ...]
    refused: tuple[tuple[str, str], ...]

    def status(self) -> RealtimeStatus:
        """Return the report for the control channel."""
        return RealtimeStatus(granted=list(self.granted), refused=dict(self.refused))


def prepare(priority: int = 10) -> RealtimeReport:
    """Request timer slack 1 ns, locked memory, a frozen heap and, last, SCHED_FIFO at `priority` (0: not requested).

    SCHED_FIFO comes last, because threads inherit the class. Never raises: a laptop or a container grants less, and the
    report shows it.
    """
    granted, refused = [], []
    for what, ask in (
        ("timer slack 1 ns", _timer_slack),
        ("memory locked", _lock_memory),
        ("heap frozen", _freeze_heap),
        (f"SCHED_FIFO {priority}", lambda: _promote(priority)),
    ):
        try:
            ask()
            granted.append(what)
        except OSError as e:
            refused.append((what, e.strerror or str(e)))
    return RealtimeReport(tuple(granted), tuple(refused))


def _timer_slack() -> None:
    _need_linux()
    _check(_libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0))


def _lock_memory() -> None:
    _need_linux()
    # With a limit on locked memory, locking future memory would make a later allocation fail, so lock only the present
    # memory.
    import resource  # not available on Windows

    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    future = _MCL_FUTURE if soft == resource.RLIM_INFINITY else 0
    _check(_libc.mlockall(_MCL_CURRENT | future))


def _freeze_heap() -> None:
    gc.collect()
    gc.freeze()


def _promote(priority: int) -> None:
    _need_linux()
    if priority <= 0:
        raise OSError(errno.EPERM, "not requested")
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


def _need_linux() -> None:
    if _libc is None:
        raise OSError(errno.ENOSYS, "only on Linux")


def _check(result: int) -> None:
    if result:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))


@contextmanager
def after_the_scans() -> Iterator[None]:
    """Let the scans go first while this thread, or a process that it starts, works.

    The thread gives up the interpreter's lock after `SWITCH_S` if a scan is due; the default of 5 ms made a scan 5.7 ms late.
    Under SCHED_FIFO it has the next lower priority, because in the normal class it would be interrupted by any process while it
    holds the lock, which made a scan 11 ms late. A process that it starts is in the normal class.
    """
    with suppress(OSError, AttributeError):  # not every system has scheduling classes
        if os.sched_getscheduler(0) == os.SCHED_FIFO:
            lower = max(1, os.sched_getparam(0).sched_priority - 1)
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(lower))
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


def make_way() -> None:
    """Wait for 0.5 ms in a thread next to that of the scans, so that a scan that is due gets the interpreter's lock."""
    time.sleep(0.0005)


class StuckAlarm:
    """The guard against a scan that does not end: `stuck_ms` after it was armed, a signal repeatedly raises `ScanStuck` in the
    logic.

    It works in the main thread, because signals arrive there. Logic that never returns to the interpreter (a C function that
    never ends) cannot be ended this way: then the gateway misses the heartbeat and sets the outputs to their safe values.
    """

    def __init__(self, stuck_ms: float) -> None:
        self._s = stuck_ms / 1000
        self._armed = False
        self._before = signal.signal(signal.SIGALRM, self._on_alarm)

    def arm(self) -> None:
        self._armed = True
        signal.setitimer(signal.ITIMER_REAL, self._s, self._s)

    def disarm(self) -> None:
        self._armed = False
        signal.setitimer(signal.ITIMER_REAL, 0)

    def close(self) -> None:
        self.disarm()
        signal.signal(signal.SIGALRM, self._before)

    def _on_alarm(self, number: int, frame: object) -> None:
        if self._armed:
            raise ScanStuck(f"{self._s * 1000:g} ms and no end")


class VirtualStuckAlarm(StuckAlarm):
    """The guard for scans under virtual time: it ends a scan that takes `stuck_ms` to two times `stuck_ms` of real time.

    Its timer is set once, is periodic, and also runs between scans. Setting and clearing it for each scan took 4.3 us of a
    scan's 50 us.
    """

    def __init__(self, stuck_ms: float) -> None:
        super().__init__(stuck_ms)
        self._expired = False
        """Whether the timer has expired during the present scan. The second time that it expires ends the scan."""
        signal.setitimer(signal.ITIMER_REAL, self._s, self._s)

    def arm(self) -> None:
        self._expired = False  # first: the timer may expire between the two lines
        self._armed = True

    def disarm(self) -> None:
        self._armed = False

    def close(self) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0)
        super().close()

    def _on_alarm(self, number: int, frame: object) -> None:
        if self._expired:
            super()._on_alarm(number, frame)
        self._expired = True


VIRTUAL_STUCK_MS = 10_000.0
"""The limit in ms of real time for a scan under virtual time, if `stuck_ms` of the system file is not longer."""


def alarm_if_free(stuck_ms: float) -> StuckAlarm | None:
    """Return a `StuckAlarm`, or None if it cannot be used: outside the main thread, or if other code uses SIGALRM."""
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "setitimer"):
        return None
    return VirtualStuckAlarm(stuck_ms) if signal.getsignal(signal.SIGALRM) is signal.SIG_DFL else None


def lead(until_due_ns: int) -> int:
    """Return how many ns before a deadline the thread has to be awake.

    The deadline is `until_due_ns` away; 0 if it has passed.
    """
    return max(0, min(LEAD_NS, until_due_ns // LEAD_SHARE))


def run_task(task: Driven, loop: asyncio.AbstractEventLoop, stop_requested: Callable[[], bool]) -> None:
    """Run `task` on the wall clock, and `loop` between its scans, until `stop_requested()`. Afterwards the outputs have their
    safe values.

    When a task stops by itself, the loop keeps running, so that its status can be read. To end a wait early, stop the
    loop.
    """
    task.start()
    polled_ns = 0
    try:
        while not stop_requested():
            now_ns = time.monotonic_ns()
            due_ns = task.deadline_ns if task.running else now_ns + STEP_NS
            slack_ns = due_ns - GUARD_NS - now_ns
            if slack_ns > 0:
                _run_loop(loop, min(slack_ns, STEP_NS))
            elif now_ns - polled_ns >= POLL_NS:
                _run_loop(loop, 0)
            else:
                wake_ns = due_ns - lead(due_ns - now_ns)
                sleep_until_ns(wake_ns)
                while wake_ns <= time.monotonic_ns() < due_ns:
                    pass
                if time.monotonic_ns() >= due_ns and task.running and not stop_requested():
                    task.run_once()
                continue
            polled_ns = time.monotonic_ns()
    finally:
        task.stop()


def _run_loop(loop: asyncio.AbstractEventLoop, for_ns: int) -> None:
    """Run callbacks for `for_ns`, or only those that are ready now if it is 0."""
    timer = loop.call_later(for_ns / NS_PER_S, loop.stop) if for_ns else loop.call_soon(loop.stop)
    try:
        loop.run_forever()
    finally:
        timer.cancel()
