"""Writing knowledge: no caller waits, a slow or full store loses nothing that fits the queue, and losses are counted."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path

import pytest
from support import eventually, run

from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.gateway.store.event import Event, Kind, StoreFull
from fieldtwin.gateway.store.sqlite_knowledge import SqliteKnowledge, in_place
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.model.knowledge import KnowledgeWriter, known_at


def value(number: float) -> Event:
    return Event(0, int(number), Kind.VALUE, "ctd.pressure", float(number))


class Moody(SqliteKnowledge):
    """A store whose disk is full while `full`, and has `room` left."""

    full = False
    room = 1 << 40
    slow: asyncio.Event | None = None

    async def append(self, origin: str, events: Sequence[Event]) -> int:
        if self.slow is not None:
            await self.slow.wait()
        if self.full:
            raise StoreFull("the knowledge store is full")
        return await super().append(origin, events)

    def room_bytes(self) -> int | None:
        return self.room


async def moody(tmp_path: Path) -> tuple[Moody, str]:
    store = await Moody.open(tmp_path / "k.db", offload=in_place)
    assert isinstance(store, Moody)
    return store, await store.own("plant", system="s", prototype=True, log="aa")


def test_observed_events_are_written_in_order_and_reported(tmp_path: Path) -> None:
    async def main() -> None:
        store, origin = await moody(tmp_path)
        told: list[int] = []
        writer = KnowledgeWriter(store, origin, WallClock(), on_written=told.append)
        running = asyncio.create_task(writer.run())
        for n in range(100):
            writer.observe(value(n))
        await eventually(lambda: writer.written == 100)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        assert [e.value for e in await store.read(origin, 1, 200)] == [float(n) for n in range(100)]
        assert told[-1] == 100
        await store.aclose()

    run(main())


def test_through_a_full_disk_nothing_is_lost_that_fits_the_queue_and_the_rest_is_counted_on_record(
    tmp_path: Path,
) -> None:
    async def main() -> None:
        store, origin = await moody(tmp_path)
        said: list[str] = []
        writer = KnowledgeWriter(store, origin, WallClock(), capacity=10, on_trouble=said.append)
        store.full = True
        for n in range(13):
            writer.observe(value(n))
            if n == 5:
                with pytest.raises(Unreachable):
                    await writer.flush()
        store.full = False
        await writer.flush()
        kept = await store.read(origin, 1, 99)
        assert (kept[0].kind, kept[0].value) == (Kind.LOSS, 3)
        assert [e.value for e in kept[1:]] == [float(n) for n in range(3, 13)]
        assert writer.dropped == 3
        await writer.flush()
        assert await store.span(origin) == (1, 11), "a loss is told once"
        await store.aclose()

    run(main())


def test_a_full_store_deletes_only_deletable_events(tmp_path: Path) -> None:
    async def main() -> None:
        store, origin = await moody(tmp_path)
        may_go = [2, 0]

        async def make_room() -> int:
            gone = may_go.pop(0)
            store.full = gone == 0
            return gone

        writer = KnowledgeWriter(store, origin, WallClock(), make_room=make_room)
        store.full = True
        writer.observe(value(1))
        assert await writer.flush() == 1
        store.full = True
        writer.observe(value(2))
        with pytest.raises(StoreFull):
            await writer.flush()
        assert (writer.queued, writer.dropped) == (1, 0)
        await store.aclose()

    run(main())


def test_low_space_is_reported_early_once_and_when_it_is_over(tmp_path: Path) -> None:
    async def main() -> None:
        store, origin = await moody(tmp_path)
        said: list[str] = []
        writer = KnowledgeWriter(store, origin, WallClock(), reserve_bytes=100 << 20, on_trouble=said.append)
        for room in (1 << 40, 99 << 20, 98 << 20, 1 << 40):
            store.room = room
            writer.observe(value(1))
            await writer.flush()
        assert said == ["the disk of the knowledge store is almost full: 99 MiB left", ""]
        assert writer.written == 4, "early: while it can still be written"
        await store.aclose()

    run(main())


def test_a_writer_stopped_in_the_middle_writes_nothing_twice(tmp_path: Path) -> None:
    async def main() -> None:
        store, origin = await moody(tmp_path)
        store.slow = asyncio.Event()
        writer = KnowledgeWriter(store, origin, WallClock())
        writer.observe(value(1))
        flushing = asyncio.create_task(writer.flush())
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        flushing.cancel()
        store.slow.set()
        with pytest.raises(asyncio.CancelledError):
            await flushing
        writer.observe(value(2))
        await writer.flush()
        assert [e.value for e in await store.read(origin, 1, 99)] == [1.0, 2.0]
        await store.aclose()

    run(main())


def test_replayed_knowledge_equals_the_last_known_state(tmp_path: Path) -> None:
    async def main() -> None:
        store, origin = await moody(tmp_path)
        await store.append(
            origin,
            [
                value(1), Event(0, 2, Kind.COMMAND, "shore", b"\0\1"), Event(0, 3, Kind.STATE, "relay", 1), value(4),
                Event(0, 5, Kind.LOSS, "knowledge", 7), Event(0, 9, Kind.STATE, "relay", -1),
            ],
        )  # fmt: skip
        known = await known_at(store.replay(origin, 0, 9))
        assert {n: e.value for n, e in known.latest.items()} == {"ctd.pressure": 4.0, "relay": 1}
        assert ([c.value for c in known.commands], known.lost, known.events) == ([b"\0\1"], 7, 5)
        await store.aclose()

    run(main())


def test_a_refusing_store_is_reported_and_queued_events_stay(tmp_path: Path) -> None:
    """A twin's commands: an unrecorded command is not sent, and the twin continues."""

    async def main() -> None:
        store, origin = await moody(tmp_path)
        said: list[str] = []
        writer = KnowledgeWriter(store, origin, WallClock(), on_trouble=said.append)
        writer.observe(value(1))
        store.full = True
        assert not await writer.try_to_flush()
        assert (said, writer.queued) == (["the knowledge store is full"], 1)
        store.full = False
        assert await writer.try_to_flush()
        assert (said[-1], writer.queued) == ("", 0)
        await store.aclose()

    run(main())
