"""SIGINT and SIGTERM of a run in virtual time take effect between two callbacks, so that everything ends in order."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Iterator
from typing import NoReturn

import pytest

from fieldtwin.emulators.virtual.loop import VirtualLoop


class Told(KeyboardInterrupt):
    """With the signal's number."""


@pytest.fixture
def handler() -> Iterator[Callable[[int, object], NoReturn]]:
    def raise_it(number: int, frame: object) -> NoReturn:
        raise Told(number)

    before = {number: signal.signal(number, raise_it) for number in (signal.SIGINT, signal.SIGTERM)}
    yield raise_it
    for number, old in before.items():
        assert signal.signal(number, old) is raise_it, "the handler was not put back"


@pytest.fixture
def loop() -> Iterator[VirtualLoop]:
    made = VirtualLoop()
    yield made
    made.close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_callback_that_runs_is_finished_first(loop: VirtualLoop, handler: object, number: signal.Signals) -> None:
    done: list[str] = []

    async def main() -> None:
        try:
            signal.raise_signal(number)
            done.append("to its next wait")
            await asyncio.sleep(1)
            done.append("too far")
        finally:
            done.append("ended")

    with pytest.raises(Told, match=str(int(number))):
        loop.run_until_complete(main())
    loop.close()
    assert done == ["to its next wait", "ended"]


def test_a_task_that_is_woken_at_that_moment_can_be_ended(loop: VirtualLoop, handler: object) -> None:
    """`set_result` calls the loop in the middle of asyncio's own code: with an exception there, the task would never be
    informed."""
    ended: list[str] = []
    call_soon, came = loop.call_soon, []

    def interrupted(*args: object, **more: object) -> object:
        if came == ["now"]:
            came.clear()
            signal.raise_signal(signal.SIGINT)
        return call_soon(*args, **more)  # type: ignore[arg-type]

    async def waits(future: asyncio.Future[None]) -> None:
        try:
            await future
            await asyncio.sleep(3600)
        finally:
            ended.append("ended")

    async def main() -> None:
        future = loop.create_future()
        task = loop.create_task(waits(future))
        await asyncio.sleep(1)
        came.append("now")
        future.set_result(None)
        await task

    loop.call_soon = interrupted  # type: ignore[method-assign, assignment]
    with pytest.raises(Told):
        loop.run_until_complete(main())
    loop.close()
    assert ended == ["ended"]


def test_a_second_one_does_not_wait_for_a_callback_that_may_never_end(loop: VirtualLoop, handler: object) -> None:
    done: list[str] = []

    async def main() -> None:
        signal.raise_signal(signal.SIGTERM)
        done.append("once")
        signal.raise_signal(signal.SIGINT)
        done.append("twice")

    with pytest.raises(Told, match=str(int(signal.SIGINT))):
        loop.run_until_complete(main())
    assert done == ["once"]


def test_a_handler_that_only_records_the_signal_lets_the_run_continue(loop: VirtualLoop) -> None:
    noted: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: noted.append(number))
    try:

        async def main() -> str:
            signal.raise_signal(signal.SIGTERM)
            await asyncio.sleep(1)
            return "done"

        assert loop.run_until_complete(main()) == "done"
        assert noted == [signal.SIGTERM]

        async def with_its_last_callback() -> None:
            signal.raise_signal(signal.SIGTERM)

        loop.run_until_complete(with_its_last_callback())
        assert noted == [signal.SIGTERM] * 2
    finally:
        signal.signal(signal.SIGTERM, before)


def test_one_that_is_ignored_stays_ignored(loop: VirtualLoop) -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:

        async def main() -> str:
            signal.raise_signal(signal.SIGINT)
            return "done"

        assert loop.run_until_complete(main()) == "done"
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
