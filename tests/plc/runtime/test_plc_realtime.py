"""The PLC on the wall clock: awake a little before its deadlines, never early, and responsive to commands meanwhile."""

from __future__ import annotations

import asyncio
import signal
import sys
import time

import pytest

from fieldtwin.gateway.core.errors import Bug
from fieldtwin.plc.program import ScanStuck
from fieldtwin.plc.runtime.realtime import (
    GUARD_NS,
    LEAD_NS,
    VirtualStuckAlarm,
    after_the_scans,
    lead,
    monotonic_ns,
    run_task,
    sleep_until_ns,
)

MS = 1_000_000


class Beat:
    """A task that only records when it ran, relative to its due time."""

    def __init__(self, cycle_ns: int, count: int) -> None:
        self.cycle_ns, self.count = cycle_ns, count
        self.late_ns: list[int] = []
        self.stopped = 0
        self.deadline_ns = 0

    @property
    def running(self) -> bool:
        return not self.stopped

    def start(self) -> None:
        self.deadline_ns = monotonic_ns() + self.cycle_ns

    def run_once(self) -> None:
        now_ns = monotonic_ns()
        self.late_ns.append(now_ns - self.deadline_ns)
        self.deadline_ns += ((now_ns - self.deadline_ns) // self.cycle_ns + 1) * self.cycle_ns

    def stop(self) -> None:
        self.stopped += 1


def test_the_lead_is_a_twentieth_of_the_way_and_never_more_than_60_us() -> None:
    assert LEAD_NS == 60_000
    assert [lead(ns) for ns in (-5 * MS, 0, 19, 400_000, 1_200_000, GUARD_NS, 1000 * MS)] == [
        0, 0, 0, 20_000, 60_000, 60_000, 60_000,
    ]  # fmt: skip


@pytest.mark.parametrize("cycle_ns", [700_000, 4 * MS])
def test_no_scan_begins_before_its_deadline_though_signals_wake_the_process(cycle_ns: int) -> None:
    """Below the guard the channel is polled, above it the channel is served in between; both are interrupted all the time."""
    beat = Beat(cycle_ns, 25)
    loop = asyncio.new_event_loop()
    served = []
    loop.call_soon(lambda: served.append(1))
    rung = []
    before = signal.signal(signal.SIGALRM, lambda *_: rung.append(1))
    signal.setitimer(signal.ITIMER_REAL, 0.0003, 0.0003)
    try:
        run_task(beat, loop, lambda: len(beat.late_ns) >= beat.count)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        loop.close()
    assert min(beat.late_ns) >= 0
    assert len(beat.late_ns) == beat.count
    assert beat.stopped == 1
    assert served
    assert rung


def test_outputs_are_made_safe_whatever_ends_the_task() -> None:
    class Raises(Beat):
        def run_once(self) -> None:
            raise Bug("broken")

    beat, loop = Raises(MS, 1), asyncio.new_event_loop()
    with pytest.raises(Bug, match="broken"):
        run_task(beat, loop, lambda: False)
    loop.close()
    assert beat.stopped == 1


def test_sleeping_ends_at_the_instant_or_after_it() -> None:
    for ahead_ns in (-MS, 0, 300_000):
        until = time.monotonic_ns() + ahead_ns
        sleep_until_ns(until)
        assert time.monotonic_ns() >= until


def test_a_scan_in_virtual_time_is_ended_by_the_second_expiry_of_the_timer() -> None:
    """The timer runs on between scans, so its first expiry may come at any time after the scan began."""
    guard = VirtualStuckAlarm(stuck_ms=3_600_000)
    try:
        for _ in range(3):
            guard.arm()
            signal.raise_signal(signal.SIGALRM)
            guard.disarm()
        guard.arm()
        signal.raise_signal(signal.SIGALRM)
        for _ in range(2):  # logic may catch the first error
            with pytest.raises(ScanStuck):
                signal.raise_signal(signal.SIGALRM)
        guard.disarm()
        signal.raise_signal(signal.SIGALRM)
    finally:
        guard.close()
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def _loop_forever() -> None:
    while True:
        pass


def test_the_timer_of_a_run_in_virtual_time_ends_a_scan_without_an_end() -> None:
    guard = VirtualStuckAlarm(stuck_ms=20)
    try:
        guard.arm()
        with pytest.raises(ScanStuck):
            _loop_forever()
    finally:
        guard.close()


def test_a_thread_next_to_the_scans_gives_up_the_interpreters_lock_early() -> None:
    before = sys.getswitchinterval()
    with after_the_scans():
        assert sys.getswitchinterval() < before / 10
    assert sys.getswitchinterval() == before
