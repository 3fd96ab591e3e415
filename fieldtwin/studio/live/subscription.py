"""Updates for several clients, each with a bounded queue: a slow client loses updates, which are counted, and does not delay
other clients.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Any

MOST_WAITING = 100
"""Largest number of updates that wait for one client. At ten updates a second this is the backlog of ten seconds."""
MOST_SUBSCRIBERS = 32

Update = dict[str, Any]


class Subscription:
    """The updates for one client. ``async for`` is not offered, because the server also has to report lost updates to the
    client.
    """

    def __init__(self) -> None:
        self._waiting: deque[Update] = deque(maxlen=MOST_WAITING)
        self._arrived = asyncio.Event()
        self.dropped = 0
        """The number of updates that this client lost because it was too slow."""
        self.ended = False

    def offer(self, update: Update) -> None:
        """Add an update. The oldest one is dropped if the queue is full."""
        if len(self._waiting) == MOST_WAITING:
            self.dropped += 1
        self._waiting.append(update)
        self._arrived.set()

    def end(self) -> None:
        """Tell the client that no further update follows."""
        self.ended = True
        self._arrived.set()

    async def next(self) -> list[Update]:
        """Wait for updates and return all that have arrived; an empty list at the end."""
        while not self._waiting and not self.ended:
            self._arrived.clear()
            await self._arrived.wait()
        taken = list(self._waiting)
        self._waiting.clear()
        return taken


class Publisher:
    """The subscribers of one source."""

    def __init__(self) -> None:
        self._subscribers: list[Subscription] = []

    @property
    def is_full(self) -> bool:
        """Return whether `MOST_SUBSCRIBERS` clients have subscribed."""
        return len(self._subscribers) >= MOST_SUBSCRIBERS

    def subscribe(self) -> Subscription:
        """Add a subscriber. The caller removes it with `unsubscribe`."""
        subscription = Subscription()
        self._subscribers.append(subscription)
        return subscription

    def unsubscribe(self, subscription: Subscription) -> None:
        """Remove a subscriber. Removing it twice does nothing."""
        if subscription in self._subscribers:
            self._subscribers.remove(subscription)

    def publish(self, update: Update) -> None:
        """Offer an update to every subscriber."""
        for subscription in self._subscribers:
            subscription.offer(update)

    def end(self) -> None:
        """Tell every subscriber that no further update follows."""
        for subscription in self._subscribers:
            subscription.end()
