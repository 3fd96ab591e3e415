"""A group of tasks: stopped in order, the first failure stops all, a cancellation is never swallowed."""

from __future__ import annotations

import asyncio

import pytest
from support import run

from fieldtwin.gateway.core.concurrency.nursery import Nursery


async def until_cancelled(name: str, log: list[str]) -> None:
    try:
        await asyncio.Event().wait()
    finally:
        log.append(name)


async def fail(error: Exception) -> None:
    raise error


def test_children_are_stopped_in_the_order_of_their_creation() -> None:
    async def main() -> None:
        log: list[str] = []
        async with Nursery() as nursery:
            for name in "abcde":
                nursery.start(until_cancelled(name, log), name)
            await asyncio.sleep(0)
        assert log == list("abcde")

    run(main())


def test_the_first_failure_stops_all_and_is_raised() -> None:
    async def main() -> None:
        log: list[str] = []

        async def together() -> None:
            async with Nursery() as nursery:
                nursery.start(until_cancelled("a", log), "a")
                nursery.start(fail(KeyError("x")), "b")
                await nursery.wait()

        with pytest.raises(KeyError):
            await together()
        assert log == ["a"]

    run(main())


def test_wait_returns_when_all_have_ended() -> None:
    async def main() -> None:
        async with Nursery() as nursery:
            done = [nursery.start(asyncio.sleep(0, i), str(i)) for i in range(3)]
            await nursery.wait()
            assert [d.result() for d in done] == [0, 1, 2]

    run(main())


def test_a_failure_on_the_way_out_is_raised_and_hides_no_other() -> None:
    async def breaks_on_cancel() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            raise ValueError("on the way out")

    async def main() -> None:
        async def together(first: Exception | None) -> None:
            async with Nursery() as nursery:
                nursery.start(breaks_on_cancel(), "a")
                await asyncio.sleep(0)
                if first is not None:
                    raise first

        with pytest.raises(ValueError, match="on the way out"):
            await together(None)
        with pytest.raises(KeyError):
            await together(KeyError("first"))

    run(main())


def test_a_child_that_failed_unnoticed_is_raised_on_leaving() -> None:
    async def main() -> None:
        async def together() -> None:
            async with Nursery() as nursery:
                nursery.start(fail(KeyError("x")), "a")
                await asyncio.sleep(0.01)  # no task waits for it

        with pytest.raises(KeyError):
            await together()

    run(main())


def test_a_task_that_is_cancelled_while_children_end_is_cancelled() -> None:
    """The children take some time; a timeout around the group still works."""

    async def slow_to_end() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0.05)

    async def main() -> None:
        ended: list[str] = []

        async def owner() -> None:
            async with Nursery() as nursery:
                nursery.start(slow_to_end(), "slow")
                await asyncio.sleep(0)
            ended.append("went on")  # must not be reached, because it was cancelled meanwhile

        task = asyncio.get_running_loop().create_task(owner())
        await asyncio.sleep(0.01)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert ended == []

    run(main())
