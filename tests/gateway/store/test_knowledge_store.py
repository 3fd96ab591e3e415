"""Knowledge stores, SQLite and PostgreSQL alike: stored data persist, once, in order, unchanged; a full disk is reported."""

from __future__ import annotations

import asyncio
import math
import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from local_postgres import server
from support import run

from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, Unreachable, UsageError
from fieldtwin.gateway.core.values import RESPONSE, Quality, Reason, TagValue
from fieldtwin.gateway.store.event import Event, Kind, KnowledgeStore, StoreFull, merged, of_tag, plain, without
from fieldtwin.gateway.store.exchange_log import ExchangeLog
from fieldtwin.gateway.store.knowledge import open_knowledge
from fieldtwin.gateway.store.schema import LATEST, SCRIPTS, script
from fieldtwin.gateway.store.sqlite_knowledge import SqliteKnowledge, in_place
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.model.thread_process import PTDigitalThreadProcess

CHECKOUT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def postgres() -> Iterator[str]:
    with server() as url:
        yield url


KINDS = ["sqlite", pytest.param("postgres", marks=pytest.mark.interop)]
_databases = iter(range(1000))


@pytest.fixture(params=KINDS)
def place(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Where an empty store will be: a file, or a separate database of the test."""
    if request.param == "sqlite":
        return str(tmp_path / "knowledge.db")
    url: str = request.getfixturevalue("postgres")
    name = f"test{next(_databases)}"

    async def make() -> None:
        import asyncpg

        db = await asyncpg.connect(url)
        await db.execute(f"CREATE DATABASE {name}")
        await db.close()

    run(make())
    return url.replace("/postgres?", f"/{name}?")


async def opened(place: str) -> KnowledgeStore:
    return await open_knowledge(place)


def value(number: int, t_ms: int = 0) -> Event:
    return Event(number, t_ms or number, Kind.VALUE, f"ctd.tag{number % 3}", number / 8)


async def own(store: KnowledgeStore, log: str = "aa") -> str:
    return await store.own("plant", system="observatory", prototype=True, log=log)


EVERY_KIND = [
    Event(0, 1, Kind.VALUE, "ctd.pressure", 10.25),
    Event(0, 2, Kind.VALUE, "ctd.count", -(1 << 63)),
    Event(0, 3, Kind.VALUE, "ctd.serial", "0042 ä"),
    Event(0, 4, Kind.VALUE, "ctd.pressure", None, int(Quality.BAD), int(Reason.TIMEOUT)),
    Event(0, 5, Kind.COMMAND, "shore", b"\0\1"),
    Event(0, 6, Kind.REFUSAL, "execute", "the plant is switched to local"),
    Event(0, 7, Kind.STATE, "relay", -1),
    Event(0, 8, Kind.PAYLOAD, "relay", b""),
    Event(0, 9, Kind.VALUE, "ctd.pressure", math.inf),
    Event(0, 9, Kind.VALUE, "ctd.pressure", math.inf),
]


def test_stored_data_are_present_in_order_and_unchanged_also_after_reopening(place: str) -> None:
    async def main() -> None:
        store = await opened(place)
        origin = await own(store)
        assert await store.append(origin, EVERY_KIND[:4]) == 4
        assert await store.append(origin, EVERY_KIND[4:]) == 10
        await store.aclose()
        store = await opened(place)
        read = await store.read(origin, 1, 100)
        assert read == [e._replace(sequence=n) for n, e in enumerate(EVERY_KIND, 1)]
        assert [type(e.value) for e in read] == [type(e.value) for e in EVERY_KIND]
        assert await store.read(origin, 9, 1) == [EVERY_KIND[8]._replace(sequence=9)]
        assert await store.span(origin) == (1, 10)
        await store.aclose()

    run(main())


def test_an_origin_is_the_same_after_a_restart_and_another_for_another_system_or_a_plant(place: str) -> None:
    async def main() -> None:
        store = await opened(place)
        assert await own(store) == "plant:aa"
        await store.aclose()
        store = await opened(place)
        assert await own(store, "bb") == "plant:aa"
        assert await store.own("plant", system="observatory", prototype=False, log="cc") == "plant:cc"
        assert await store.own("plant", system="dam", prototype=True, log="dd") == "plant:dd"
        assert await store.origins() == {"plant:aa": True, "plant:cc": False, "plant:dd": True}, "ruling 15"
        with pytest.raises(UsageError):
            await store.own("a:b", system="x", prototype=True, log="aa")
        await store.aclose()

    run(main())


def test_a_store_names_the_owner_of_every_origin_and_learns_it_for_older_ones(place: str) -> None:
    async def main() -> None:
        store = await opened(place)
        await own(store)
        of_west, of_nobody = EVERY_KIND[0]._replace(sequence=1), EVERY_KIND[1]._replace(sequence=1)
        await store.keep("plant:w", [of_west], system="west", prototype=True)
        await store.keep("plant:n", [of_nobody])
        await store.note_lost("plant:l", 1, 3)
        assert set(await store.origins("observatory")) == {"plant:aa", "plant:n", "plant:l"}
        assert set(await store.origins("west")) == {"plant:w", "plant:n", "plant:l"}
        await store.aclose()
        store = await opened(place)
        for _ in range(2):
            await store.keep("plant:n", [of_nobody], system="east")
        await store.keep("plant:w", [of_west], system="east")
        assert await store.origins("east") == {"plant:n": False, "plant:l": False}
        assert set(await store.origins("west")) == {"plant:w", "plant:l"}, "whose it is stays"
        await store.aclose()

    run(main())


def test_the_same_event_twice_is_one_and_gaps_are_known_until_they_are_filled_or_lost(place: str) -> None:
    async def main() -> None:
        store = await opened(place)
        assert await store.gaps("far:1") == []
        assert await store.span("far:1") == (1, 0)
        assert await store.keep("far:1", [value(3), value(4), value(9)], prototype=True) == 3
        assert await store.keep("far:1", [value(4), value(5)]) == 1
        assert await store.gaps("far:1") == [(1, 2), (6, 8)]
        await store.note_lost("far:1", 1, 1)
        await store.note_lost("far:1", 7, 8)
        assert await store.gaps("far:1") == [(2, 2), (6, 6)]
        assert await store.keep("far:1", [value(6), value(2)]) == 2
        assert await store.gaps("far:1") == []
        assert [e.sequence for e in await store.read("far:1", 1, 99)] == [2, 3, 4, 5, 6, 9]
        await store.aclose()

    run(main())


def test_deleted_events_are_not_a_gap_and_their_numbers_are_never_reused(place: str) -> None:
    async def main() -> None:
        store = await opened(place)
        origin = await own(store)
        await store.append(origin, [value(0)] * 5)
        assert await store.forget(origin, 3) == 3
        assert await store.span(origin) == (4, 5)
        assert await store.forget(origin, 5) == 2
        assert await store.append(origin, [value(0)]) == 6
        assert await store.gaps(origin) == []
        await store.aclose()

    run(main())


def test_a_time_is_replayed_in_blocks(place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldtwin.gateway.store.sqlite_knowledge.BLOCK", 7)

    async def main() -> None:
        store = await opened(place)
        origin = await own(store)
        await store.append(origin, [value(n, 1000 + n) for n in range(1, 41)])
        seen = [e.t_ms async for block in store.replay(origin, 1010, 1031) for e in block]
        assert seen == list(range(1010, 1031))
        await store.aclose()

    run(main())


def test_two_processes_share_a_store(place: str) -> None:
    async def main() -> None:
        one, two = await opened(place), await opened(place)
        origin = await own(one)
        await two.aclose()
        two = await opened(place)
        assert await two.append(origin, [value(0)._replace(name="new.name")]) == 1
        assert await one.append(origin, [value(0)._replace(name="other.name")]) == 2
        assert [e.name for e in await one.read(origin, 1, 9)] == ["new.name", "other.name"]
        assert [e.name for e in await two.read(origin, 1, 9)] == ["new.name", "other.name"]
        await one.aclose()
        await two.aclose()

    run(main())


def test_an_origin_that_is_not_ours_is_not_written(place: str) -> None:
    async def main() -> None:
        store = await opened(place)
        with pytest.raises(UsageError, match="not an origin of this side"):
            await store.append("plant:xx", [value(1)])
        await store.aclose()

    run(main())


# -- values ---------------------------------------------------------------------------------------------------------------


@given(
    given_value=st.booleans() | st.integers() | st.floats() | st.text(max_size=20) | st.binary(max_size=20) | st.none()
)
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_plain_value_comes_back_from_a_file_as_it_went(
    tmp_path: Path, given_value: bool | int | float | str | None
) -> None:
    async def main() -> None:
        store = await SqliteKnowledge.open(tmp_path / "v.db", offload=in_place)
        origin = await own(store)
        kept = plain(given_value)
        number = await store.append(origin, [Event(0, 0, Kind.VALUE, "x", kept)])
        (back,) = await store.read(origin, number, 1)
        assert (type(back.value), back.value) == (type(kept), kept)
        await store.aclose()

    asyncio.run(main())


def test_values_that_cannot_be_stored_exactly_are_reported() -> None:
    assert of_tag(5, "x", TagValue(math.nan, Quality.GOOD))[4:] == (None, Quality.BAD, Reason.NOT_A_NUMBER)
    assert plain(1 << 64) == float(1 << 64)
    assert plain(True) == 1
    assert plain("a\0b\udc80") == "ab?"


@pytest.mark.parametrize("value", ["x" * 4097, b"x" * 4097, "a\0b", "a\udc80", (1 << 64) - 1, "\u00e9" * 2049])
def test_a_value_that_is_not_stored_exactly_is_uncertain_and_says_why(value: str | bytes | int) -> None:
    """Defect: the store cut off a text at 4096 bytes, and kept it with the quality good."""
    assert of_tag(5, "x", TagValue(value, Quality.GOOD))[5:] == (Quality.UNCERTAIN, Reason.NOT_EXACT)
    stale = of_tag(5, "x", TagValue(value, Quality.BAD, Reason.STALE))
    assert stale[5:] == (Quality.BAD, Reason.STALE)  # the worse of both


@pytest.mark.parametrize("value", ["x" * 4096, b"x" * 4096, True, 1 << 64, (1 << 63) - 1, 0.1, None, "\u00e9" * 2048])
def test_a_value_that_is_stored_exactly_keeps_its_quality(value: str | bytes | float | None) -> None:
    assert of_tag(5, "x", TagValue(value, Quality.GOOD))[4:] == (value, Quality.GOOD, Reason.NONE)


def test_a_payload_that_does_not_fit_is_shared_as_uncertain() -> None:
    process = PTDigitalThreadProcess("gateway", WallClock())
    assert process.share(Kind.PAYLOAD, "modem", RESPONSE(b"x" * 4096))[5:] == (Quality.GOOD, Reason.NONE)
    assert process.share(Kind.PAYLOAD, "modem", RESPONSE(b"x" * 4097))[5:] == (Quality.UNCERTAIN, Reason.NOT_EXACT)


@given(
    st.lists(st.tuples(st.integers(1, 30), st.integers(0, 5))),
    st.lists(st.tuples(st.integers(1, 30), st.integers(0, 5))),
)
def test_ranges_are_sets_of_numbers(a: list[tuple[int, int]], b: list[tuple[int, int]]) -> None:
    def numbers(ranges: list[tuple[int, int]]) -> set[int]:
        return {n for first, last in ranges for n in range(first, last + 1)}

    a, b = ([(first, first + more) for first, more in side] for side in (a, b))
    assert numbers(merged(a)) == numbers(a)
    assert numbers(without(a, b)) == numbers(a) - numbers(b)
    assert merged(without(a, b)) == without(a, b)


# -- versions -------------------------------------------------------------------------------------------------------------


def test_a_file_of_every_older_version_is_migrated_with_its_content(tmp_path: Path) -> None:
    path = tmp_path / "old.db"
    for version in range(LATEST):
        path.unlink(missing_ok=True)
        with closing(sqlite3.connect(path)) as db:
            for number in range(1, version + 1):
                db.executescript(f"{script(number)}PRAGMA user_version={number};")
            if version >= 1:
                db.execute("INSERT INTO run (system, prototype) VALUES ('observatory', 1)")
                db.execute("INSERT INTO exchange VALUES (1, 1, 'relay', 7, 8, x'0102')")
            db.commit()

        async def main() -> None:
            store = await SqliteKnowledge.open(path, offload=in_place)
            await store.append(await own(store), [value(1)])
            await store.aclose()

        run(main())
        with closing(sqlite3.connect(path)) as db:
            assert db.execute("PRAGMA user_version").fetchone() == (LATEST,)
            if version >= 1:
                assert db.execute("SELECT payload FROM exchange").fetchall() == [(b"\1\2",)]
    assert set(SCRIPTS) == set(range(1, LATEST + 1))


def test_a_newer_file_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "new.db"
    with closing(sqlite3.connect(path)) as db:
        db.executescript(f"CREATE TABLE theirs (x); PRAGMA user_version={LATEST + 1};")
    before = path.read_bytes()
    with pytest.raises(FileInvalid, match="written by a newer fieldtwin") as caught:
        run(SqliteKnowledge.open(path))
    assert caught.value.exit_code == 3
    with pytest.raises(FileInvalid, match="written by a newer fieldtwin"):
        ExchangeLog(path, system="observatory", prototype=True)
    assert path.read_bytes() == before


@pytest.mark.interop
def test_a_newer_database_is_refused(postgres: str) -> None:
    async def main() -> None:
        import asyncpg

        db = await asyncpg.connect(postgres)
        await db.execute("CREATE DATABASE newer")
        await db.close()
        url = postgres.replace("/postgres?", "/newer?")
        await (await open_knowledge(url)).aclose()
        db = await asyncpg.connect(url)
        await db.execute("INSERT INTO fieldtwin.version VALUES (99)")
        await db.close()
        with pytest.raises(FileInvalid, match="newer fieldtwin; expected schema 1 or older; got schema 99"):
            await open_knowledge(url)

    run(main())


@pytest.mark.interop
def test_a_server_that_goes_away_is_unreachable_and_used_again_when_it_is_back(postgres: str) -> None:
    async def main() -> None:
        import asyncpg

        store = await open_knowledge(postgres)
        origin = await own(store)
        db = await asyncpg.connect(postgres)
        await db.execute("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid <> pg_backend_pid()")
        await db.close()
        try:
            last = await store.append(origin, [value(1)])
        except Unreachable:  # it detected the loss now, or it had detected it before
            last = await store.append(origin, [value(1)])
        assert last == 1
        await store.aclose()
        with pytest.raises(Unreachable):
            await open_knowledge(postgres.replace("host=", "host=/nowhere"))

    run(main())


def test_a_file_that_is_not_a_store_is_not_changed(tmp_path: Path) -> None:
    path = tmp_path / "letter.txt"
    path.write_text("dear plant, " * 100)
    with pytest.raises(FileInvalid, match="not a store of fieldtwin"):
        run(SqliteKnowledge.open(path))
    with pytest.raises(FieldtwinError):
        run(SqliteKnowledge.open(tmp_path / "no" / "such" / "folder.db"))


# -- full disks, crashes ----------------------------------------------------------------------------------------------------


def test_a_store_at_its_bound_reports_it_keeps_its_data_and_continues_when_there_is_room(tmp_path: Path) -> None:
    async def main() -> None:
        store = await SqliteKnowledge.open(tmp_path / "k.db", max_bytes=64 * 4096, offload=in_place)
        origin = await own(store)
        batch = [value(n)._replace(name=f"tag{n}") for n in range(500)]

        async def until_full() -> None:
            for _ in range(100):
                await store.append(origin, batch)

        with pytest.raises(StoreFull):
            await until_full()
        last = (await store.span(origin))[1]
        assert last % 500 == 0, "a batch is kept whole or not at all"
        assert last > 0
        room = store.room_bytes()
        assert room is not None
        assert room < 64 * 4096
        await store.forget(origin, last)
        assert await store.append(origin, batch) == last + 500
        assert [e.name for e in await store.read(origin, last + 1, 2)] == ["tag0", "tag1"]
        await store.aclose()

    run(main())


def test_names_first_written_on_a_full_disk_are_stored_when_there_is_room(tmp_path: Path) -> None:
    """SQLite itself rolls back a transaction that did not fit, including the name of a new tag or origin; a cache must not
    keep them."""

    async def main() -> None:
        store = await SqliteKnowledge.open(tmp_path / "k.db", max_bytes=64 * 4096, offload=in_place)
        origin = await own(store)
        known = [Event(0, 1, Kind.VALUE, "known", 1.5)] * 400
        fresh = [Event(0, 1, Kind.VALUE, "fresh", 2.5), Event(0, 1, Kind.VALUE, "later", 3.5)]

        async def until_full() -> None:
            while True:
                await store.append(origin, known)

        with pytest.raises(StoreFull):
            await until_full()
        for _ in range(3):  # each one alone is too large
            with pytest.raises(StoreFull):
                await store.append(origin, [*fresh, *known])
            with pytest.raises(StoreFull):
                await store.keep(
                    "plant:other", [e._replace(sequence=n) for n, e in enumerate(known, 1)], system="other"
                )
        await store.forget(origin, 1000)
        last = await store.append(origin, fresh)
        await store.keep("plant:other", [fresh[1]._replace(sequence=1)], system="other")
        await store.aclose()
        store = await SqliteKnowledge.open(tmp_path / "k.db", offload=in_place)
        assert [e.name for e in await store.read(origin, last - 1, 9)] == ["fresh", "later"]
        assert await store.origins("other") == {"plant:other": False}
        assert [e.name for e in await store.read("plant:other", 1, 9)] == ["later"]
        await store.aclose()

    run(main())


def test_nothing_that_was_acknowledged_is_lost_when_the_process_is_killed(tmp_path: Path) -> None:
    """It prints each number when `append` has returned; when killed, at least that many are stored, complete and without gaps."""
    program = (
        "import asyncio, sys; from pathlib import Path\n"
        "from fieldtwin.gateway.store.event import Event\n"
        "from fieldtwin.gateway.store.sqlite_knowledge import SqliteKnowledge, in_place\n"
        "async def main():\n"
        f"    store = await SqliteKnowledge.open(Path({str(tmp_path / 'k.db')!r}), offload=in_place)\n"
        "    origin = await store.own('plant', system='s', prototype=True, log='aa')\n"
        "    while True: print(await store.append(origin, [Event(0, 1, 0, 'x', 1.5)] * 7), flush=True)\n"
        "asyncio.run(main())\n"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", program], env={**os.environ, "PYTHONPATH": str(CHECKOUT)}, stdout=subprocess.PIPE
    )
    assert child.stdout is not None
    told = [int(child.stdout.readline()) for _ in range(40)]
    child.send_signal(signal.SIGKILL)
    told += [int(line) for line in child.stdout.read().split(b"\n")[:-1] if line]
    child.wait()
    child.stdout.close()

    async def main() -> None:
        store = await SqliteKnowledge.open(tmp_path / "k.db", offload=in_place)
        first, last = await store.span("plant:aa")
        assert (first, last % 7) == (1, 0)
        assert last >= told[-1]
        assert await store.gaps("plant:aa") == []
        await store.aclose()

    run(main())
