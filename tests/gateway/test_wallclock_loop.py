"""The event loop whose waits are ended by a timerfd: never early, the timer is not visible outside, no descriptor remains
open."""

from __future__ import annotations

import asyncio
import os
import selectors
import socket
import sys
import threading
import time
from typing import Any

import pytest

from fieldtwin.gateway import wallclock

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="timerfd is Linux's")


def open_files() -> set[str]:
    return {f"{name}={os.readlink(f'/proc/self/fd/{name}')}" for name in os.listdir("/proc/self/fd") if _there(name)}


def _there(name: str) -> bool:
    return os.path.lexists(f"/proc/self/fd/{name}")


def selector() -> selectors.BaseSelector:
    made = wallclock.TimerSelector.make()
    assert made is not None
    return made


@pytest.mark.parametrize("wait_s", [1e-9, 0.0004, 0.0021, 0.01])
def test_a_wait_is_ended_by_the_timer_and_never_early(wait_s: float) -> None:
    with selector() as subject:
        for _ in range(3):
            began_s = time.monotonic()
            assert subject.select(wait_s) == []
            assert time.monotonic() - began_s >= wait_s


def test_the_timer_ends_a_wait_that_epoll_would_have_slept_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the timer can end it: the timeout given to epoll itself is far off."""
    monkeypatch.setattr(
        selectors.EpollSelector, "select", lambda self, timeout: self._selector.poll(30.0 * bool(timeout), 1)
    )
    with selector() as subject:
        began_s = time.monotonic()
        subject.select(0.002)
        assert time.monotonic() - began_s < 20


def test_an_event_at_the_end_of_a_wait_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wallclock, "LEAD_SHARE", 1)
    monkeypatch.setattr(wallclock, "LEAD_NS", 20_000_000_000)
    here, there = socket.socketpair()
    with selector() as subject, here, there:
        subject.register(here, selectors.EVENT_READ)
        threading.Timer(0.01, there.send, (b"x",)).start()
        began_s = time.monotonic()
        [(key, _)] = subject.select(10)
        assert key.fileobj is here
        assert time.monotonic() - began_s < 5


def test_nothing_spins_before_the_end_of_a_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """A timer that expired while a different event ended its wait is reported in the next wait, which continues nevertheless."""
    asked: list[float | None] = []
    select = selectors.EpollSelector.select

    def counted(self: selectors.EpollSelector, timeout: float | None = None) -> Any:
        asked.append(timeout)
        return select(self, timeout)

    monkeypatch.setattr(selectors.EpollSelector, "select", counted)
    monkeypatch.setattr(wallclock, "LEAD_NS", 0)
    here, there = socket.socketpair()
    with selector() as subject, here, there:
        subject.register(here, selectors.EVENT_READ)
        there.send(b"x")
        assert subject.select(1e-6)
        here.recv(1)
        time.sleep(0.001)
        began_s = time.monotonic()
        assert subject.select(0.02) == []
        assert time.monotonic() - began_s >= 0.02
    assert len(asked) < 10


def test_a_ready_descriptor_is_reported_together_with_an_expired_timer() -> None:
    here, there = socket.socketpair()
    with selector() as subject, here, there:
        subject.register(here, selectors.EVENT_READ)
        assert subject.select(0.001) == []
        there.send(b"x")
        for timeout in (None, 0, 0.5):
            [(key, mask)] = subject.select(timeout)
            assert (key.fileobj, mask) == (here, selectors.EVENT_READ)


def test_a_timer_that_ran_out_wakes_one_wait_only() -> None:
    """Otherwise an idle loop would spin."""
    with selector() as subject:
        subject.select(0.001)
        time.sleep(0.002)  # the wait may have been ended by epoll's own millisecond
        subject.select(0)
        assert all(subject._selector.poll(0, 4) == [] for _ in range(3))  # type: ignore[attr-defined]


def test_a_loop_runs_on_it_and_leaves_nothing_open() -> None:
    async def main() -> float:
        loop = asyncio.get_running_loop()
        assert isinstance(loop._selector, wallclock.TimerSelector)  # type: ignore[attr-defined]
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.003):
                await asyncio.Event().wait()
        began_s = loop.time()
        await asyncio.sleep(0.002)
        return loop.time() - began_s

    before = open_files()
    assert wallclock.run(main()) >= 0.002
    assert open_files() == before


def test_without_a_timer_the_loop_is_the_usual_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wallclock.TimerSelector, "make", classmethod(lambda cls: None))
    assert wallclock.run(asyncio.sleep(0.001, "done")) == "done"
