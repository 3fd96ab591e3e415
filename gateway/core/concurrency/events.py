"""The paper's event handlers: one Producer, many Consumers, each with its own bounded queue.

A queue is a bounded FIFO, not a set (SPEC ruling 2): it keeps the order and duplicates; when it overflows, it drops the
oldest item and counts it. Everything is synchronous and free of I/O: the owner of a Consumer drains it.
"""

from __future__ import annotations

from abc import ABC
from collections import deque
from collections.abc import Iterator
from typing import Generic, TypeVar

from fieldtwin.gateway.core.errors import Bug
from fieldtwin.gateway.core.values import DATA

D = TypeVar("D", bound=DATA)


class EventHandler(ABC):  # noqa: B024  the schema has state and no operations; Producer and Consumer are the concrete ones
    """Registered for exactly one event, by name. Abstract: make a Producer or a Consumer."""

    def __init__(self, event: str) -> None:
        if type(self) is EventHandler:
            raise Bug("an abstract EventHandler was made", expected="Producer or Consumer")
        self.event = event


class Consumer(EventHandler, Generic[D]):
    """Observes one event and handles the occurrences in order.

    `dropped` counts the items that a full queue lost; it is always reported.
    """

    def __init__(self, event: str, capacity: int = 256) -> None:
        super().__init__(event)
        self.queue: deque[D] = deque(maxlen=capacity)
        self.dropped = 0

    def observe(self, item: D) -> None:
        """Append `item`; a full queue drops its oldest and counts it."""
        if len(self.queue) == self.queue.maxlen:
            self.dropped += 1
        self.queue.append(item)

    def consume(self) -> D:
        """Take the first item. The queue must not be empty."""
        if not self.queue:
            raise Bug("consume from an empty queue", where=self.event)
        return self.queue.popleft()

    def put_back(self, item: D) -> None:
        """Make `item`, consumed but not handled, the first again. A full queue drops its newest item and counts it."""
        if len(self.queue) == self.queue.maxlen:
            self.dropped += 1
        self.queue.appendleft(item)

    def drain(self) -> Iterator[D]:
        """Consume the items that are in the queue now, one by one. Items that arrive meanwhile wait for the next drain."""
        for _ in range(len(self.queue)):
            yield self.consume()


class Producer(EventHandler, Generic[D]):
    """Emits one event to every Consumer that subscribed to it."""

    def __init__(self, event: str) -> None:
        super().__init__(event)
        self._consumers: list[Consumer[D]] = []

    def subscribe(self, consumer: Consumer[D]) -> None:
        """Let `consumer` observe from now on. It must be registered for the same event; subscribing twice has no
        further effect.
        """
        if consumer.event != self.event:
            raise Bug("a consumer of another event", expected=self.event, got=consumer.event)
        if consumer not in self._consumers:
            self._consumers.append(consumer)

    @property
    def observed(self) -> bool:
        """Return whether any Consumer is subscribed; without one, the event need not be created."""
        return bool(self._consumers)

    def emit(self, occurred: D) -> None:
        """Pass on exactly what occurred, in the order of subscription. Never waits."""
        for consumer in self._consumers:
            consumer.observe(occurred)
