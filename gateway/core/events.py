"""The paper's event handlers: one Producer, many Consumers, each with its own bounded queue.

A queue is a bounded FIFO, not a set (SPEC ruling 2): order is kept, duplicates survive, overflow drops the oldest and
is counted. Synchronous and free of I/O: a Consumer is drained by whoever owns it.
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
    """Observes one event and handles what occurred in order.

    `dropped` counts what a full queue lost; it is reported, never hidden.
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
        """Make `item`, consumed and not dealt with, the first again; a full queue drops its newest and counts it."""
        if len(self.queue) == self.queue.maxlen:
            self.dropped += 1
        self.queue.appendleft(item)

    def drain(self) -> Iterator[D]:
        """Consume what is there now, one by one; what arrives meanwhile waits for the next drain."""
        for _ in range(len(self.queue)):
            yield self.consume()


class Producer(EventHandler, Generic[D]):
    """Emits one event to every Consumer that subscribed to it."""

    def __init__(self, event: str) -> None:
        super().__init__(event)
        self._consumers: list[Consumer[D]] = []

    def subscribe(self, consumer: Consumer[D]) -> None:
        """Let `consumer` observe from now on. It must be registered for the same event; twice is once."""
        if consumer.event != self.event:
            raise Bug("a consumer of another event", expected=self.event, got=consumer.event)
        if consumer not in self._consumers:
            self._consumers.append(consumer)

    @property
    def observed(self) -> bool:
        """Whether anybody would see an event; one that nobody sees need not be made."""
        return bool(self._consumers)

    def emit(self, occurred: D) -> None:
        """Pass on exactly what occurred, in the order of subscription. Never waits."""
        for consumer in self._consumers:
            consumer.observe(occurred)
