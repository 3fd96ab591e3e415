"""A store of events in a PostgreSQL database, for twins that share one server. It needs the extra `postgres`.

All tables are in a separate schema, `fieldtwin`, which also holds the schema's version. One connection is used; it is opened
again after it was lost.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from importlib.resources import files
from typing import Any, TypeVar

import asyncpg

from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, Unreachable, UsageError
from fieldtwin.gateway.store.event import Event, StoreFull, Value, merged, without

T = TypeVar("T")
SCRIPTS = {1: "postgres_0001.sql"}
LATEST = max(SCRIPTS)
BLOCK = 20_000
CONNECT_S = 10.0
COMMAND_S = 60.0
_LOCK = 0x6669656C  # "fiel": while one process migrates, others wait
_SELECT = (
    "SELECT sequence, t_ms, kind, name, whole, real, words, data, quality, reason FROM event WHERE origin = $1 AND "
)
_INSERT = (
    "INSERT INTO event SELECT $1, * FROM unnest($2::bigint[], $3::bigint[], $4::smallint[], $5::text[], $6::bigint[],"
    " $7::float8[], $8::text[], $9::bytea[], $10::smallint[], $11::smallint[])"
)


class PostgresKnowledge:
    """A PostgreSQL store, see `fieldtwin.gateway.store.event.KnowledgeStore`.

    ``store = await PostgresKnowledge.open("postgresql://user@host/database")``.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        self._where = url.rpartition("@")[2]  # without user and password
        self._lock = asyncio.Lock()
        self._db: asyncpg.Connection | None = None
        self._origins: dict[str, int] = {}
        self._whose: set[str] = set()
        """Origins of other writers for which the store records the system."""

    @classmethod
    async def open(cls, url: str) -> PostgresKnowledge:
        self = cls(url)
        await self._do(lambda db: asyncio.sleep(0))
        return self

    async def _do(self, work: Callable[[asyncpg.Connection], Awaitable[T]]) -> T:
        async with self._lock:
            try:
                if self._db is None or self._db.is_closed():
                    self._db = await self._connect()
                return await work(self._db)
            except asyncpg.DiskFullError as e:
                raise StoreFull("the knowledge store is full", where=self._where) from e
            except (
                asyncpg.PostgresError,
                asyncpg.InterfaceError,
                asyncpg.InternalClientError,
                OSError,
                TimeoutError,
            ) as e:
                self._drop()
                raise Unreachable(f"PostgreSQL: {str(e) or type(e).__name__}", where=self._where) from e
            except ValueError as e:
                raise UsageError("the URL of a database", expected="postgresql://user@host/database", got=str(e)) from e

    def _drop(self) -> None:
        """Drop the connection after any error, so that the next operation opens a new one."""
        if self._db is not None:
            self._db.terminate()
            self._db = None

    async def _connect(self) -> asyncpg.Connection:
        db = await asyncpg.connect(self._url, timeout=CONNECT_S, command_timeout=COMMAND_S)
        try:
            async with db.transaction():
                await db.execute(f"SELECT pg_advisory_xact_lock({_LOCK})")
                await db.execute("CREATE SCHEMA IF NOT EXISTS fieldtwin")
                await db.execute("CREATE TABLE IF NOT EXISTS fieldtwin.version (version INTEGER NOT NULL)")
                await db.execute("SET search_path TO fieldtwin")
                await self._migrate(db)
        except BaseException:
            db.terminate()
            raise
        await db.execute("SET search_path TO fieldtwin")
        self._origins = {row["name"]: row["id"] for row in await db.fetch("SELECT name, id FROM origin")}
        return db

    async def _migrate(self, db: asyncpg.Connection) -> None:
        version = await db.fetchval("SELECT max(version) FROM version") or 0
        if version > LATEST:
            raise FileInvalid(
                "the store was written by a newer fieldtwin", path=self._where, expected=f"schema {LATEST} or older",
                got=f"schema {version}", hint="the store was not changed",
            )  # fmt: skip
        for number in range(version + 1, LATEST + 1):
            await db.execute(files("fieldtwin.gateway.store").joinpath(SCRIPTS[number]).read_text(encoding="utf-8"))
            await db.execute("INSERT INTO version VALUES ($1)", number)

    # -- origins ----------------------------------------------------------------------------------------------------------

    async def own(self, name: str, *, system: str, prototype: bool, log: str) -> str:
        async def work(db: asyncpg.Connection) -> str:
            row = await db.fetchrow(
                "SELECT name FROM origin WHERE own AND system = $1 AND prototype = $2 AND starts_with(name, $3)"
                " ORDER BY id DESC", system, prototype, f"{name}:",
            )  # fmt: skip
            if row is not None:
                return str(row["name"])
            await self._add_origin(db, f"{name}:{log}", own=True, system=system, prototype=prototype)
            return f"{name}:{log}"

        if ":" in name or "*" in name or not name:
            raise UsageError("the name of a side of a thread", expected="a word without colon or star", got=repr(name))
        return await self._do(work)

    async def origins(self, system: str = "") -> dict[str, bool]:
        which = "SELECT name, prototype FROM origin WHERE $1 IN ('', system) OR system = '' ORDER BY id"
        rows = await self._do(lambda db: db.fetch(which, system))
        return {row["name"]: row["prototype"] for row in rows}

    async def _add_origin(self, db: asyncpg.Connection, name: str, *, own: bool, system: str, prototype: bool) -> int:
        await db.execute(
            "INSERT INTO origin (name, own, system, prototype) VALUES ($1, $2, $3, $4) ON CONFLICT (name) DO NOTHING",
            name, own, system, prototype,
        )  # fmt: skip
        number: int = await db.fetchval("SELECT id FROM origin WHERE name = $1", name)
        self._origins[name] = number
        return number

    # -- writing ----------------------------------------------------------------------------------------------------------

    async def append(self, origin: str, events: Sequence[Event]) -> int:
        async def work(db: asyncpg.Connection) -> int:
            number = self._origins.get(origin)
            if number is None:
                raise UsageError(
                    "not an origin of this side", got=origin, expected=", ".join(self._origins) or "one from own()"
                )
            async with db.transaction():
                await db.execute("SELECT 1 FROM origin WHERE id = $1 FOR UPDATE", number)
                last = (await self._span(db, number))[1]
                await db.execute(
                    _INSERT, number, *_columns([e._replace(sequence=n) for n, e in enumerate(events, last + 1)])
                )
            return last + len(events)

        return await self._do(work)

    async def keep(self, origin: str, events: Sequence[Event], *, system: str = "", prototype: bool = False) -> int:
        async def work(db: asyncpg.Connection) -> int:
            async with db.transaction():
                number = self._origins.get(origin)
                if number is None:
                    number = await self._add_origin(db, origin, own=False, system=system, prototype=prototype)
                if system and origin not in self._whose:
                    await db.execute("UPDATE origin SET system = $2 WHERE id = $1 AND system = ''", number, system)
                done = await db.execute(f"{_INSERT} ON CONFLICT DO NOTHING", number, *_columns(events))
            self._whose.add(origin)
            return int(done.split()[-1])

        try:
            return await self._do(work)
        except FieldtwinError:
            self._origins.pop(origin, None)  # perhaps this row was not stored either
            raise

    # -- reading ----------------------------------------------------------------------------------------------------------

    async def _span(self, db: asyncpg.Connection, origin: int) -> tuple[int, int]:
        row = await db.fetchrow("SELECT min(sequence) a, max(sequence) b FROM event WHERE origin = $1", origin)
        gone = await db.fetchval("SELECT max(last) FROM lost WHERE origin = $1", origin)
        if row["b"] is None:
            return (gone + 1, gone) if gone else (1, 0)
        return row["a"], max(row["b"], gone or 0)

    async def span(self, origin: str) -> tuple[int, int]:
        return await self._do(lambda db: self._span(db, self._origins.get(origin, 0)))

    async def gaps(self, origin: str) -> list[tuple[int, int]]:
        async def work(db: asyncpg.Connection) -> list[tuple[int, int]]:
            number = self._origins.get(origin, 0)
            holes = await db.fetch(
                "SELECT previous + 1 a, sequence - 1 b FROM (SELECT sequence, lag(sequence, 1, 0::bigint)"
                " OVER (ORDER BY sequence) previous FROM event WHERE origin = $1) e WHERE sequence > previous + 1", number,
            )  # fmt: skip
            lost = await db.fetch("SELECT first, last FROM lost WHERE origin = $1", number)
            return without([(r["a"], r["b"]) for r in holes], [(r["first"], r["last"]) for r in lost])

        return await self._do(work)

    async def read(self, origin: str, first: int, limit: int) -> list[Event]:
        number = self._origins.get(origin, 0)
        return await self._events("sequence >= $2 ORDER BY sequence LIMIT $3", number, first, limit)

    async def replay(self, origin: str, since_ms: int, until_ms: int) -> AsyncIterator[list[Event]]:
        first = 0
        where = "sequence > $2 AND t_ms >= $3 AND t_ms < $4 ORDER BY sequence LIMIT $5"
        while block := await self._events(where, self._origins.get(origin, 0), first, since_ms, until_ms, BLOCK):
            first = block[-1].sequence
            yield block

    async def _events(self, where: str, *key: int) -> list[Event]:
        rows = await self._do(lambda db: db.fetch(_SELECT + where, *key))
        return [Event(row[0], row[1], row[2], row[3], _value(row), row[8], row[9]) for row in rows]

    # -- bounds -----------------------------------------------------------------------------------------------------------

    async def note_lost(self, origin: str, first: int, last: int) -> None:
        async def work(db: asyncpg.Connection) -> None:
            async with db.transaction():
                number = self._origins.get(origin)
                if number is None:
                    number = await self._add_origin(db, origin, own=False, system="", prototype=False)
                await self._lose(db, number, first, last)

        await self._do(work)

    async def _lose(self, db: asyncpg.Connection, origin: int, first: int, last: int) -> None:
        known = await db.fetch("DELETE FROM lost WHERE origin = $1 RETURNING first, last", origin)
        ranges = merged([*((r["first"], r["last"]) for r in known), (first, last)])
        await db.executemany("INSERT INTO lost VALUES ($1, $2, $3)", [(origin, a, b) for a, b in ranges])

    async def forget(self, origin: str, through: int) -> int:
        async def work(db: asyncpg.Connection) -> int:
            number = self._origins.get(origin, 0)
            async with db.transaction():
                done = await db.execute("DELETE FROM event WHERE origin = $1 AND sequence <= $2", number, through)
                count = int(done.split()[-1])
                if count:
                    await self._lose(db, number, 1, through)
            return count

        return await self._do(work)

    def room_bytes(self) -> int | None:
        return None

    async def aclose(self) -> None:
        if self._db is not None:
            await self._db.close()


def _columns(events: Sequence[Event]) -> list[list[Any]]:
    """Return events as one list for each column except the origin's."""
    return [
        [e.sequence for e in events], [e.t_ms for e in events], [e.kind for e in events], [e.name for e in events],
        *([e.value if type(e.value) is kind else None for e in events] for kind in (int, float, str, bytes)),
        [e.quality for e in events], [e.reason for e in events],
    ]  # fmt: skip


def _value(row: Any) -> Value:
    return next((v for v in row[4:8] if v is not None), None)
