"""The paper's event handlers: one Producer, many Consumers, each with its own bounded queue.

A queue is a bounded FIFO, not a set (docs/explanation/paper.md, ruling 2): it keeps the order and duplicates; when it overflows,
it drops the oldest item and counts it. No method waits or does I/O: the code that owns a Consumer takes the items out of its
queue.
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
    """The common base of Producer and Consumer: a handler registered for exactly one event, by name. Abstract."""

    def __init__(self, event: str) -> None:
        if type(self) is EventHandler:
            raise Bug("an abstract EventHandler was made", expected="Producer or Consumer")
        self.event = event


class Consumer(EventHandler, Generic[D]):
    """A handler that observes one event and handles its occurrences in order.

    `dropped` counts the items that were lost because the queue was full.
    """

    def __init__(self, event: str, capacity: int = 256) -> None:
        super().__init__(event)
        self.queue: deque[D] = deque(maxlen=capacity)
        self.dropped = 0

    def observe(self, item: D) -> None:
        """Append `item`. A full queue drops its oldest item and counts it."""
        if len(self.queue) == self.queue.maxlen:
            self.dropped += 1
        self.queue.append(item)

    def consume(self) -> D:
        """Take the first item. The queue must not be empty."""
        if not self.queue:
            raise Bug("consume from an empty queue", where=self.event)
        return self.queue.popleft()

    def put_back(self, item: D) -> None:
        """Put `item`, which was consumed but not handled, back at the head. A full queue drops its newest item and counts it."""
        if len(self.queue) == self.queue.maxlen:
            self.dropped += 1
        self.queue.appendleft(item)

    def drain(self) -> Iterator[D]:
        """Consume the items that are in the queue now, one by one. Items that arrive meanwhile wait for the next drain."""
        for _ in range(len(self.queue)):
            yield self.consume()


class Producer(EventHandler, Generic[D]):
    """A handler that emits one event to every Consumer that subscribed to it."""

    def __init__(self, event: str) -> None:
        super().__init__(event)
        self._consumers: list[Consumer[D]] = []

    def subscribe(self, consumer: Consumer[D]) -> None:
        """Pass events to `consumer` from now on. It must be registered for the same event. Subscribing it twice has no effect."""
        if consumer.event != self.event:
            raise Bug("a consumer of another event", expected=self.event, got=consumer.event)
        if consumer not in self._consumers:
            self._consumers.append(consumer)

    @property
    def observed(self) -> bool:
        """Return whether any Consumer is subscribed. If not, the caller need not create the event."""
        return bool(self._consumers)

    def emit(self, occurred: D) -> None:
        """Pass `occurred` unchanged to every Consumer, in the order of subscription. Never waits."""
        for consumer in self._consumers:
            consumer.observe(occurred)
