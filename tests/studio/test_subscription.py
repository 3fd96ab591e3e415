"""A client that is too slow loses the oldest updates, knows their number, and delays no other client."""

from __future__ import annotations

import asyncio

from fieldtwin.studio.live.subscription import MOST_WAITING, Publisher


def test_a_slow_client_loses_the_oldest_updates_and_a_fast_one_none() -> None:
    async def main() -> None:
        publisher = Publisher()
        slow, fast = publisher.subscribe(), publisher.subscribe()
        received = []
        for number in range(MOST_WAITING + 10):
            publisher.publish({"number": number})
            received += await fast.next()
        assert [u["number"] for u in received] == list(range(MOST_WAITING + 10))
        assert fast.dropped == 0
        late = await slow.next()
        assert slow.dropped == 10
        assert [u["number"] for u in late] == list(range(10, MOST_WAITING + 10))

    asyncio.run(main())


def test_the_end_is_told_after_the_last_update() -> None:
    async def main() -> None:
        publisher = Publisher()
        subscription = publisher.subscribe()
        publisher.publish({"number": 1})
        publisher.end()
        assert [u["number"] for u in await subscription.next()] == [1]
        assert await subscription.next() == []

    asyncio.run(main())
