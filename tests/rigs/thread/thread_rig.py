"""Two twins on a thread for tests: each with a store that persists and an end that can die, over carriers that can be
disturbed."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.errors import ConnectionLost, Unreachable
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.gateway.store.sqlite_knowledge import SqliteKnowledge, in_place
from fieldtwin.twin.thread.end import ThreadEnd
from fieldtwin.twin.thread.frames import Frame, Schema
from fieldtwin.twin.thread.link import Carrier, Link

SCHEMA = Schema(("ctd.pressure", "ctd.temperature", "relay"))


def value(n: int) -> Event:
    return Event(0, 1_790_000_000_000 + n * 100, Kind.VALUE, SCHEMA.names[n % 2], n / 8)


class ShakyLink(Link):
    """Lose, repeat and reorder the frames on a link."""

    def __init__(self, link: Link, chance: random.Random, loss: float) -> None:
        self._link = link
        self._chance = chance
        self._loss = loss
        self._held: Frame | None = None
        self.ack_delay_ns = link.ack_delay_ns

    async def send(self, frame: Frame) -> None:
        if self._chance.random() < self._loss:
            return
        if self._chance.random() < 0.1 and self._held is None:
            self._held = frame
            return
        await self._link.send(frame)
        if self._held is not None:
            held, self._held = self._held, None
            await self._link.send(held)
        if self._chance.random() < 0.1:
            await self._link.send(frame)

    async def receive(self) -> Frame:
        return await self._link.receive()

    def fit(self, tag: bytes, events: Sequence[Event]) -> int:
        return self._link.fit(tag, events)

    def knows(self, schema: bytes) -> bool:
        return self._link.knows(schema)

    async def aclose(self) -> None:
        await self._link.aclose()


class ShakyCarrier(Carrier):
    """`cut` ends the present link, and no new one opens while it is in effect."""

    def __init__(self, carrier: Carrier, seed: int, loss: float = 0.2) -> None:
        self.name = carrier.name
        self.cut = False
        self._carrier = carrier
        self._chance = random.Random(seed)
        self._loss = loss

    async def open(self) -> Link:
        if self.cut:
            raise Unreachable("the carrier is cut")
        return ShakyLink(await self._carrier.open(), self._chance, self._loss)

    async def aclose(self) -> None:
        await self._carrier.aclose()


class WatchedCarrier(Carrier):
    """Record the sent frames: the content of a capture towards the other side."""

    def __init__(self, carrier: Carrier, sent: list[Frame]) -> None:
        self.name = carrier.name
        self._carrier = carrier
        self._sent = sent

    async def open(self) -> Link:
        link = await self._carrier.open()
        send = link.send

        async def watched(frame: Frame) -> None:
            self._sent.append(frame)
            await send(frame)

        link.send = watched  # type: ignore[method-assign]
        return link

    async def aclose(self) -> None:
        await self._carrier.aclose()


class Twin:
    """One side. A test may `start` and `kill` it any number of times; the store is on disk."""

    def __init__(
        self,
        name: str,
        folder: Path,
        clock: Clock,
        carrier: Callable[[], Carrier],
        schema: Schema = SCHEMA,
        sends: bool = True,
    ) -> None:
        self.name = name
        self.origin = ""
        self.arrived: list[Event] = []
        self._path = folder / f"{name}.db"
        self._clock = clock
        self._carrier = carrier
        self._schema = schema
        self._sends = sends
        self._task: asyncio.Task[None] | None = None
        self.store: SqliteKnowledge
        self.end: ThreadEnd
        self.carrier: Carrier

    async def start(self) -> None:
        self.store = await SqliteKnowledge.open(self._path, offload=in_place)
        self.origin = await self.store.own(self.name, system="test", prototype=True, log="5f3a91c2")
        self.carrier = self._carrier()
        self.end = ThreadEnd(
            self.store, self.carrier, self._schema, self._clock,
            origin=self.origin if self._sends else "", prototype=True, on_events=self._arrive,
        )  # fmt: skip
        self._task = asyncio.get_running_loop().create_task(self.end.run(), name=self.name)
        await asyncio.sleep(0.001)

    async def _arrive(self, origin: str, events: Sequence[Event]) -> None:
        self.arrived += events

    async def log(self, *events: Event) -> None:
        self.end.appended(await self.store.append(self.origin, events))

    async def kill(self) -> None:
        assert self._task is not None
        self._task.cancel()
        with suppress(asyncio.CancelledError, ConnectionLost):
            await self._task
        await self.carrier.aclose()
        await self.store.aclose()

    async def all_of(self, origin: str) -> list[Event]:
        return await self.store.read(origin, 1, 1_000_000)


async def equal(one: Twin, other: Twin) -> bool:
    """Return whether both logs are the same on both sides, and both sides know it."""
    if one.end.waiting or other.end.waiting or one.end.out is None or other.end.out is None:
        return False
    return await one.all_of(one.origin) == await other.all_of(one.origin) and await one.all_of(
        other.origin
    ) == await other.all_of(other.origin)
