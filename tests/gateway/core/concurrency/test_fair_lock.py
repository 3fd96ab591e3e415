"""The fair lock of a shared resource, and the wait with a timeout: in order, and safe to cancel."""

from __future__ import annotations

import asyncio
from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.concurrency.fair_lock import FairLock
from fieldtwin.gateway.core.concurrency.timeout import ring, start_timeout


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 4), st.booleans()), max_size=12))
@settings(max_examples=60)
def test_one_at_a_time_in_the_order_of_requests_despite_cancellations(users: list[tuple[int, int, bool]]) -> None:
    """Each arrives at a time, works for a while, and may be cancelled half a unit after its arrival."""
    turn, began, spans = FairLock(), [], []

    async def user(number: int, works: int, loop: VirtualLoop) -> None:
        if not turn.take():
            await turn.wait()
        try:
            began.append(number)
            span = [loop.now_ns, 0]
            spans.append(span)
            await asyncio.sleep(works)
        finally:
            span[1] = loop.now_ns
            turn.pass_on()

    async def main(loop: VirtualLoop) -> None:
        tasks = []
        for number, (comes, works, cancelled) in enumerate(users):
            task: asyncio.Task[None] | None = None

            async def late(number: int = number, comes: int = comes, works: int = works) -> None:
                await asyncio.sleep(comes)
                await user(number, works, loop)

            task = loop.create_task(late())
            tasks.append(task)
            if cancelled:
                loop.call_later(comes + 0.5, task.cancel)
        await asyncio.gather(*tasks, return_exceptions=True)

    loop = VirtualLoop()
    loop.run_until_complete(main(loop))
    loop.close()
    assert all(before[1] <= after[0] for before, after in pairwise(spans)), "two had it at once"
    asked = sorted(began, key=lambda number: (users[number][0], number))
    assert began == asked
    assert turn.take(), "it is free in the end"


def test_cancelled_at_the_instant_at_which_it_was_passed_on_it_goes_to_the_next() -> None:
    turn, had = FairLock(), []

    async def user(name: str) -> None:
        if not turn.take():
            await turn.wait()
        had.append(name)
        turn.pass_on()

    async def main() -> None:
        assert turn.take()
        first, second = asyncio.ensure_future(user("first")), asyncio.ensure_future(user("second"))
        await asyncio.sleep(0)
        turn.pass_on()
        first.cancel()
        await asyncio.gather(first, second, return_exceptions=True)

    asyncio.run(main())
    assert had == ["second"]


def test_a_timeout_ends_by_itself_or_is_ended_early_on_either_loop() -> None:
    async def main() -> tuple[float, float]:
        loop = asyncio.get_running_loop()
        began = loop.time()
        waiter, end = start_timeout(loop, 0.02)
        await waiter
        alone = loop.time() - began
        if end is not None:
            end()
        waiter, end = start_timeout(loop, 3600.0)
        loop.call_soon(ring, waiter)
        await waiter
        ring(waiter)  # a second call has no effect
        if end is not None:
            end()
        return alone, loop.time() - began

    virtual = VirtualLoop()
    alone, both = virtual.run_until_complete(main())
    virtual.close()
    assert (round(alone, 9), round(both, 9)) == (0.02, 0.02)
    alone, both = asyncio.run(main())
    assert alone >= 0.019
    assert both < 60
