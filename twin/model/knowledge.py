"""The knowledge of a twin: a record of what it observed, decided and refused, written continuously and replayed later.

`KnowledgeWriter` decouples the sources of events, which must never wait, from the store, which may be slow or full. Its
queue is bounded. It counts the events that do not fit, and records that count as knowledge too. It does not depend on
any database.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass, field

from fieldtwin.gateway.core.clock import NS_PER_MS, Clock
from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.gateway.store.event import Event, Kind, KnowledgeStore, StoreFull

QUEUE = 200_000
"""The capacity of the queue in events: four seconds at the highest write rate that the project promises."""
BATCH = 10_000
EVERY_MS = 100
RETRY_MS = 1000
RESERVE_BYTES = 64 << 20
LOSS_NAME = "knowledge"
_SAYS_WHAT_IS = {int(Kind.VALUE), int(Kind.STATE)}

MakeRoom = Callable[[], Awaitable[int]]
"""A function that deletes old events from the store and returns their number. 0 means that no event may be deleted."""


class KnowledgeWriter:
    """The writer of the log of one origin (the plant, or a twin), in batches of events. `observe` never waits and never fails;
    `run` writes until cancelled.

    The writer calls `on_trouble` once when less than `reserve_bytes` of room is left, once when nothing can be written, and
    with ``""`` when the trouble is over. After each batch it calls `on_written` with the number of the last event written. When
    the store is full, `make_room` may delete events that are no longer needed.
    """

    def __init__(
        self,
        store: KnowledgeStore,
        origin: str,
        clock: Clock,
        *,
        capacity: int = QUEUE,
        reserve_bytes: int = RESERVE_BYTES,
        on_trouble: Callable[[str], None] = lambda text: None,
        on_written: Callable[[int], None] = lambda last: None,
        make_room: MakeRoom | None = None,
    ) -> None:
        self.origin = origin
        self.written = 0
        self.dropped = 0
        self.last = 0
        self.trouble = ""
        self._store = store
        self._clock = clock
        self._queue: deque[Event] = deque()
        self._capacity = capacity
        self._reserve = reserve_bytes
        self._on_trouble = on_trouble
        self._on_written = on_written
        self._make_room = make_room
        self._lost = 0
        """The number of dropped events whose loss is not recorded yet."""

    @property
    def queued(self) -> int:
        """Return the number of events that were observed and are not in the store yet."""
        return len(self._queue)

    def observe(self, event: Event) -> None:
        """Queue an event. A full queue drops its oldest event."""
        if len(self._queue) >= self._capacity:
            self._queue.popleft()
            self.dropped += 1
            self._lost += 1
        self._queue.append(event)

    async def run(self) -> None:
        """Write queued events until cancelled.

        After an error of the store the write is repeated. An event that the store has taken is never written twice.
        """
        while True:
            wait_ms = EVERY_MS if await self.try_to_flush() else RETRY_MS
            await self._clock.sleep_until_ns(self._clock.monotonic_ns() + wait_ms * NS_PER_MS)

    async def try_to_flush(self) -> bool:
        """Call `flush`. If the store raises an error, report the trouble and return False."""
        try:
            await self.flush()
        except Unreachable as e:
            self._say(str(e))
            return False
        return True

    async def flush(self) -> int:
        """Write every queued event and return how many were written.

        Raises `Unreachable`, and keeps the events not written.
        """
        done = 0
        while self._queue or self._lost:
            try:
                done += await self._write()
            except StoreFull:
                if self._make_room is None or not await self._make_room():
                    raise
        self._look_at_room()
        return done

    async def _write(self) -> int:
        lost = self._lost
        batch = [self._queue.popleft() for _ in range(min(BATCH, len(self._queue)))]
        admitted = [Event(0, self._clock.utc_ns() // NS_PER_MS, Kind.LOSS, LOSS_NAME, lost)] if lost else []
        writing = asyncio.ensure_future(self._store.append(self.origin, [*admitted, *batch]))
        try:
            self.last = await asyncio.shield(writing)
        except asyncio.CancelledError:
            with suppress(
                Unreachable
            ):  # the task was cancelled while it wrote: wait for the outcome, so that no event is stored twice
                await writing
                batch = []
            self._give_back(batch)
            raise
        except Unreachable:
            self._give_back(batch)
            raise
        self._lost -= lost
        self.written += len(batch)
        self._on_written(self.last)
        return len(batch)

    def _give_back(self, batch: list[Event]) -> None:
        """Put events that were not written back at the front of the queue. If it overflows, drop the oldest events."""
        room = max(0, self._capacity - len(self._queue))
        gone = max(0, len(batch) - room)
        self.dropped += gone
        self._lost += gone
        self._queue.extendleft(reversed(batch[gone:]))

    def _look_at_room(self) -> None:
        room = self._store.room_bytes()
        if room is not None and room < self._reserve:
            self._say(f"the disk of the knowledge store is almost full: {room >> 20} MiB left")
        else:
            self._say("")

    def _say(self, text: str) -> None:
        # the free room rose above the reserve, but by less than the margin: it is not reported again when it falls once
        # more
        if text.partition(":")[0] != self.trouble.partition(":")[0]:
            self.trouble = text
            self._on_trouble(text)


@dataclass
class Known:
    """The knowledge at a given time: the latest event of each tag and state machine, and the number of events replayed."""

    latest: dict[str, Event] = field(default_factory=dict)
    commands: list[Event] = field(default_factory=list)
    events: int = 0
    lost: int = 0

    def learn(self, events: list[Event]) -> None:
        """Update the knowledge with a block of events, in their order."""
        self.events += len(events)
        for event in events:
            if event.kind in _SAYS_WHAT_IS:
                self.latest[event.name] = event
            elif event.kind == Kind.COMMAND:
                self.commands.append(event)
            elif event.kind == Kind.LOSS and isinstance(event.value, int):
                self.lost += event.value


async def known_at(blocks: AsyncIterator[list[Event]]) -> Known:
    """Replay blocks of events and return the knowledge at their end."""
    known = Known()
    async for block in blocks:
        known.learn(block)
    return known
