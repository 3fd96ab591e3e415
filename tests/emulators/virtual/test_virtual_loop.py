"""The virtual loop: time is a number, the order is fixed, access to the outside is blocked."""

from __future__ import annotations

import asyncio
import datetime
import random
import re
import socket
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Coroutine
from contextvars import ContextVar, copy_context
from datetime import UTC, date
from time import perf_counter
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.emulators.virtual.chance import seeded
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.emulators.virtual.loop import START_NS, Deadlock, Escape, VirtualLoop
from fieldtwin.emulators.virtual.seal import sealed
from fieldtwin.gateway.core.errors import Bug


def run(main: Callable[[VirtualLoop], Coroutine[Any, Any, Any]]) -> Any:
    loop = VirtualLoop()
    try:
        with sealed():
            return loop.run_until_complete(main(loop))
    finally:
        loop.close()


def test_a_day_takes_no_time_and_ends_to_the_nanosecond() -> None:
    async def main(loop: VirtualLoop) -> None:
        await VirtualClock(loop).sleep_until_ns(START_NS + 86_400 * 10**9 + 1)
        assert loop.now_ns == START_NS + 86_400 * 10**9 + 1
        assert loop.time() == pytest.approx(loop.now_ns / 1e9)

    run(main)


@given(st.lists(st.integers(0, 5), max_size=30))
@settings(max_examples=60, deadline=None)
def test_timers_run_in_order_of_time_and_then_of_asking(delays_ms: list[int]) -> None:
    ran: list[tuple[int, int]] = []

    async def main(loop: VirtualLoop) -> None:
        for number, delay_ms in enumerate(delays_ms):
            loop.call_later(delay_ms / 1000, ran.append, (delay_ms, number))
        await asyncio.sleep(0.01)

    run(main)
    assert ran == sorted(ran)
    assert len(ran) == len(delays_ms)


def test_ready_callbacks_run_before_time_advances() -> None:
    seen: list[str] = []

    async def main(loop: VirtualLoop) -> None:
        loop.call_later(0.001, seen.append, "timer")
        for n in range(3):
            loop.call_soon(seen.append, str(n))
            await asyncio.sleep(0)
        await asyncio.sleep(0.001)

    run(main)
    assert seen == ["0", "1", "2", "timer"]


def test_cancelled_timers_never_run_and_take_no_room() -> None:
    ran: list[int] = []

    async def main(loop: VirtualLoop) -> int:
        most = 0
        for n in range(20_000):
            timer = loop.call_later(1 + n / 1000, ran.append, n)
            if n % 1_000:
                timer.cancel()
            loop.timer(100).set_result(None)  # one that ends before its time counts as cancelled
            most = max(most, len(loop._timers))
        await asyncio.sleep(30)
        return most

    assert run(main) < 2_500
    assert ran == list(range(0, 20_000, 1_000))


def test_timeouts_and_waits_of_asyncio_work() -> None:
    async def main(loop: VirtualLoop) -> tuple[bool, int]:
        timed_out = False
        try:
            async with asyncio.timeout(2.5):
                await asyncio.Event().wait()
        except TimeoutError:
            timed_out = True
        task = loop.create_task(asyncio.sleep(7, "done"))
        assert await asyncio.wait_for(task, 8) == "done"
        return timed_out, loop.now_ns - START_NS

    assert run(main) == (True, 9_500_000_000)


def test_a_deadlock_names_the_waiting_tasks() -> None:
    """Each task by its name, with the line in its author's code and the awaited object, not with asyncio's innermost line."""

    async def takes(first: asyncio.Lock, second: asyncio.Lock) -> None:
        async with first:
            await asyncio.sleep(1)
            async with second:
                pass

    async def reads(queue: asyncio.Queue[bytes]) -> None:
        await queue.get()

    async def main(loop: VirtualLoop) -> None:
        one, other = asyncio.Lock(), asyncio.Lock()
        tasks = [
            loop.create_task(takes(one, other), name="bus"),
            loop.create_task(takes(other, one), name="plc"),
            loop.create_task(reads(asyncio.Queue(8)), name="reader"),
        ]
        await asyncio.gather(*tasks)

    with pytest.raises(Deadlock) as e:
        run(main)
    here = r"test_a_deadlock\S+<locals>\.{} \(test_virtual_loop.py:\d+\)"
    for told in (
        f"bus at {here.format('takes')} for Lock.acquire \\[locked, waiters:1\\]; ",
        f"plc at {here.format('takes')} for Lock.acquire \\[locked, waiters:1\\]; ",
        f"reader at {here.format('reads')} for Queue.get maxsize=8 ",
        f"at {here.format('main')} for tasks bus, plc, reader",
    ):
        assert re.search(told, str(e.value)), str(e.value)


def test_a_deadlock_names_the_awaited_task() -> None:
    async def main(loop: VirtualLoop) -> None:
        await loop.create_task(waits(loop.create_future()), name="who never ends")

    async def waits(future: asyncio.Future[None]) -> None:
        await future

    with pytest.raises(
        Deadlock, match=r"main \(test_v\S+ for task who never ends.*who never ends at .*waits .* for a future"
    ):
        run(main)


def test_time_without_progress_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldtwin.emulators.virtual.loop.STUCK_AFTER", 1_000)

    async def main(loop: VirtualLoop) -> None:
        def again() -> None:
            loop.call_soon(again)

        again()
        await asyncio.sleep(1)

    with pytest.raises(Deadlock, match="time stands still"):
        run(main)


async def _executor(loop: VirtualLoop) -> None:
    await loop.run_in_executor(None, lambda: 1)


async def _to_thread(loop: VirtualLoop) -> None:
    await asyncio.to_thread(lambda: 1)


async def _connect(loop: VirtualLoop) -> None:
    await asyncio.open_connection("127.0.0.1", 1)


async def _subprocess(loop: VirtualLoop) -> None:
    await asyncio.create_subprocess_exec("true")


async def _popen(loop: VirtualLoop) -> None:
    subprocess.run([sys.executable, "-c", ""], check=True)  # noqa: ASYNC221  it must be refused


async def _socket(loop: VirtualLoop) -> None:
    socket.socket()


async def _thread(loop: VirtualLoop) -> None:
    threading.Thread(target=lambda: None).start()


async def _clock(loop: VirtualLoop) -> None:
    time.monotonic_ns()


async def _wall_clock(loop: VirtualLoop) -> None:
    time.time()


async def _taken_clock(loop: VirtualLoop) -> None:
    perf_counter()


async def _clock_by_number(loop: VirtualLoop) -> None:
    time.clock_gettime(time.CLOCK_MONOTONIC)


async def _local_time(loop: VirtualLoop) -> None:
    time.strftime("%H")


async def _date(loop: VirtualLoop) -> None:
    datetime.datetime.now(UTC)


async def _taken_date(loop: VirtualLoop) -> None:
    date.today()


async def _sleep(loop: VirtualLoop) -> None:
    time.sleep(0)  # noqa: ASYNC251  it must be refused


async def _threadsafe(loop: VirtualLoop) -> None:
    loop.call_soon_threadsafe(lambda: None)


async def _reader(loop: VirtualLoop) -> None:
    loop.add_reader(0, lambda: None)


WAYS_OUT = [
    (_executor, "loop.run_in_executor"),
    (_to_thread, "loop.run_in_executor"),
    (_connect, "loop.(getaddrinfo|create_connection)"),
    (_subprocess, "loop.subprocess_exec|a process|child watcher"),
    (_popen, "a process"),
    (_socket, "a socket"),
    (_thread, "a thread"),
    (_clock, "time.monotonic_ns"),
    (_wall_clock, "time.time"),
    (_taken_clock, "time.perf_counter"),
    (_clock_by_number, "time.clock_gettime"),
    (_local_time, "time.strftime"),
    (_date, "datetime.now"),
    (_taken_date, "date.today"),
    (_sleep, "time.sleep"),
    (_threadsafe, "a call from another thread"),
    (_reader, "loop.add_reader"),
]


@pytest.mark.parametrize(("way", "told"), WAYS_OUT, ids=lambda x: getattr(x, "__name__", ""))
def test_every_way_out_names_the_culprit(way: Callable[[VirtualLoop], Coroutine[Any, Any, None]], told: str) -> None:
    with pytest.raises(Escape, match=told) as e:
        run(way)
    assert f"({way.__name__})" in e.value.where
    assert "test_virtual_loop.py" in e.value.where


def test_dates_are_unchanged() -> None:
    """Only the current time is unavailable: the rest of `datetime` works, and creates objects of the real types."""
    real, before = datetime.datetime, datetime.datetime(2026, 11, 21, tzinfo=UTC)

    async def main(loop: VirtualLoop) -> None:
        made = [
            datetime.datetime(2026, 11, 21, tzinfo=UTC),
            datetime.datetime.fromisoformat("2026-11-21T00:00:00+00:00"),
        ]
        made += [datetime.datetime.fromtimestamp(1795219200, UTC), datetime.datetime.strptime("20261121Z", "%Y%m%d%z")]
        assert {type(one) for one in made} == {real}
        assert set(made) == {before}
        assert isinstance(before, datetime.datetime)
        assert issubclass(real, datetime.datetime)
        assert not isinstance(date(2026, 11, 21), datetime.datetime)
        assert isinstance(before, date)
        assert time.strftime("%Y", time.gmtime(1795219200)) == "2026"

    run(main)
    assert datetime.datetime is real
    assert date is datetime.date
    assert type(date.today()) is date
    assert perf_counter is time.perf_counter


def test_other_threads_and_later_code_keep_their_clocks() -> None:
    took: list[float] = []

    async def main(loop: VirtualLoop) -> None:
        release.set()
        while not took:
            pass  # the other thread reads the clock while this one is sealed

    release = threading.Event()

    def read_the_clock() -> None:
        release.wait(5)
        took.append(time.monotonic())

    thread = threading.Thread(target=read_the_clock)
    thread.start()
    run(main)
    thread.join()
    assert took
    assert time.monotonic() > 0
    assert isinstance(time.time(), float)


def test_an_uncaught_error_is_kept() -> None:
    async def fails() -> None:
        raise ValueError("lost")

    async def main(loop: VirtualLoop) -> list[str]:
        def bad() -> None:
            raise ValueError("in a callback")

        loop.call_soon(bad)
        await asyncio.sleep(0)
        return [f"{context['message']}: {context['exception']}" for context in loop.unhandled]

    [error] = run(main)
    assert re.fullmatch(r"Exception in callback .*\.bad\(\) at .*test_virtual_loop\.py:\d+: in a callback", error)


def test_a_cancelled_callback_is_not_called_and_its_arguments_are_released() -> None:
    class Held:
        pass

    async def main(loop: VirtualLoop) -> list[bool]:
        called: list[Held] = []
        held = Held()
        alive = weakref.ref(held)
        calls = [loop.call_soon(called.append, held), loop.call_later(1, called.append, held)]
        for call in calls:
            call.cancel()
        del held
        released = alive() is None
        await asyncio.sleep(2)
        return [released, not called, *(call.cancelled() for call in calls)]

    assert all(run(main))


def test_a_timer_has_its_time_and_its_context() -> None:
    variable: ContextVar[str] = ContextVar("variable", default="")

    async def main(loop: VirtualLoop) -> str:
        seen: list[str] = []
        context = copy_context()
        context.run(variable.set, "of the context")
        timer = loop.call_later(0.25, lambda: seen.append(variable.get()), context=context)
        assert timer.when() == loop.time() + 0.25
        assert timer.get_context() is context
        assert not timer.cancelled()
        await asyncio.sleep(1)
        return seen[0]

    assert run(main) == "of the context"


def test_it_is_closed_once_and_runs_alone() -> None:
    loop = VirtualLoop()

    async def inner() -> None:
        with pytest.raises(Bug, match="inside another loop"):
            VirtualLoop().run_forever()

    loop.run_until_complete(inner())
    assert not loop.is_running()
    loop.close()
    assert loop.is_closed()


def test_an_interrupt_lets_every_task_end_before_the_loop_is_closed() -> None:
    """Otherwise Python ends their coroutines when it collects them, without a loop, and prints a traceback for each."""
    loop = VirtualLoop()
    ended: list[str] = []

    async def works(name: str) -> None:
        try:
            await asyncio.sleep(3600)
        finally:
            asyncio.current_task()
            await asyncio.sleep(1)  # clean-up takes time, and virtual time passes
            ended.append(name)

    async def main() -> None:
        async with asyncio.TaskGroup() as group:
            for name in "ab":
                group.create_task(works(name))
            await asyncio.sleep(1)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        loop.run_until_complete(main())
    loop.close()
    assert sorted(ended) == ["a", "b"]


def test_a_task_that_will_not_end_keeps_no_loop_open() -> None:
    loop = VirtualLoop()

    async def stubborn() -> None:
        while True:
            try:
                await asyncio.sleep(1)
            except asyncio.CancelledError:
                continue

    async def main() -> None:
        task = loop.create_task(stubborn())
        await asyncio.sleep(2)
        assert not task.done()

    loop.run_until_complete(main())
    loop.close()
    assert loop.is_closed()


def test_global_random_generators_have_the_runs_seed_while_it_lasts() -> None:
    numpy = pytest.importorskip("numpy")
    random.seed(99)
    before = random.getstate()
    seen = []
    for seed in (7, 7, 8):
        with seeded(seed):
            seen.append((random.random(), float(numpy.random.random())))
    assert seen[0] == seen[1]
    assert seen[0][0] != seen[2][0]
    assert seen[0][1] != seen[2][1]
    assert random.getstate() == before
