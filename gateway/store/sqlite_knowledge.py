"""A store of events in a SQLite file (write-ahead log), the default: no server, one file, readable while it is written.

`offload` carries out the work on the file: in a separate thread in real time (the default), in the caller's thread in virtual
time (`in_place`).
"""

from __future__ import annotations

import asyncio
import os
import sqlite3
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, Unreachable, UsageError
from fieldtwin.gateway.store.event import Event, StoreFull, merged, without
from fieldtwin.gateway.store.schema import migrate, refuse_newer

T = TypeVar("T")
Work = Callable[[], Any]
Offload = Callable[[Work], Awaitable[Any]]
BLOCK = 20_000
"""The number of events that a replay reads in one block, large enough that switching to the thread costs little."""
NAMES_MAX = 100_000
PAGE = 4096
BUSY_S = 5.0
_COLUMNS = "sequence, t_ms, kind, name, value, quality, reason"


async def in_place(work: Work) -> Any:
    """Run `work` immediately in the caller's thread and return its result. Used in virtual time, which has no threads."""
    return work()


class SqliteKnowledge:
    """A SQLite store, see `fieldtwin.gateway.store.event.KnowledgeStore`. `max_bytes` limits the size of the file; 0: no limit.

    ``store = await SqliteKnowledge.open(path)``. Raises `FileInvalid` for a file that is not a fieldtwin store.
    """

    def __init__(self, path: Path, max_bytes: int, offload: Offload | None) -> None:
        self.path = path
        self._max_bytes = max_bytes
        self._thread = ThreadPoolExecutor(1, "knowledge") if offload is None else None
        self._offload = offload or self._in_thread
        self._origins: dict[str, int] = {}
        self._whose: set[str] = set()
        """Origins of other writers for which the store records the system."""
        self._names: dict[str, int] = {}
        self._texts: dict[int, str] = {}
        self._unsure = False
        """Whether the numbers of names and origins have to be read again before they are used for writing."""

    @classmethod
    async def open(cls, path: Path, *, max_bytes: int = 0, offload: Offload | None = None) -> SqliteKnowledge:
        self = cls(path, max_bytes, offload)
        try:
            await self._offload(self._open)
        except BaseException:
            if self._thread is not None:
                self._thread.shutdown()
            raise
        return self

    def _open(self) -> None:
        try:
            self._db = sqlite3.connect(self.path, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
        except sqlite3.OperationalError as e:
            raise Unreachable(f"cannot open the knowledge store: {e}", where=str(self.path)) from e
        try:
            refuse_newer(self._db, self.path)
            self._db.execute("PRAGMA journal_mode=WAL")
            # a number that the other twin has received must never be assigned twice
            self._db.execute("PRAGMA synchronous=FULL")
            if self._max_bytes:
                self._db.execute(f"PRAGMA max_page_count={max(64, self._max_bytes // PAGE)}")
            migrate(self._db, self.path)
            self._learn()
        except Exception as e:
            self._db.close()
            raise self._translated(e) from e

    def _learn(self) -> None:
        self._origins = dict(self._db.execute("SELECT name, id FROM origin").fetchall())
        self._names = dict(self._db.execute("SELECT text, id FROM event_name").fetchall())
        self._texts = {i: text for text, i in self._names.items()}
        self._unsure = False

    async def _in_thread(self, work: Work) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._thread, work)

    async def _do(self, work: Callable[[], T]) -> T:
        def translated() -> T:
            try:
                if self._unsure:
                    self._learn()
                return work()
            except Exception as e:
                # The names and origins just added may not be stored: SQLite itself rolls a transaction back when the
                # disk is full.
                self._unsure = True
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise self._translated(e) from e

        done: T = await self._offload(translated)
        return done

    def _translated(self, e: Exception) -> Exception:
        if isinstance(e, FieldtwinError) or not isinstance(e, sqlite3.Error):
            return e
        if e.sqlite_errorcode == sqlite3.SQLITE_FULL:
            return StoreFull(
                "the knowledge store is full",
                where=str(self.path),
                hint="free some space; the stored events are intact",
            )
        if isinstance(e, sqlite3.OperationalError):
            return Unreachable(f"the knowledge store cannot be used: {e}", where=str(self.path))
        return FileInvalid(
            f"not a store of fieldtwin: {e}", path=str(self.path), hint="move the file away; a new one is created"
        )

    # -- origins ----------------------------------------------------------------------------------------------------------

    async def own(self, name: str, *, system: str, prototype: bool, log: str) -> str:
        def work() -> str:
            row = self._db.execute(
                "SELECT name FROM origin WHERE own AND system = ? AND prototype = ? AND name GLOB ? ORDER BY id DESC",
                (system, prototype, f"{name}:*"),
            ).fetchone()
            if row is not None:
                return str(row[0])
            self._add_origin(f"{name}:{log}", own=True, system=system, prototype=prototype)
            return f"{name}:{log}"

        if ":" in name or "*" in name or not name:
            raise UsageError("the name of a side of a thread", expected="a word without colon or star", got=repr(name))
        return await self._do(work)

    async def origins(self, system: str = "") -> dict[str, bool]:
        def work() -> dict[str, bool]:
            rows = self._db.execute(
                "SELECT name, prototype FROM origin WHERE ? IN ('', system) OR system = '' ORDER BY id", (system,)
            )
            return {n: bool(p) for n, p in rows}

        return await self._do(work)

    def _add_origin(self, name: str, *, own: bool, system: str, prototype: bool) -> int:
        self._db.execute(
            "INSERT INTO origin (name, own, system, prototype) VALUES (?, ?, ?, ?) ON CONFLICT (name) DO NOTHING",
            (name, own, system, prototype),
        )
        (self._origins[name],) = self._db.execute("SELECT id FROM origin WHERE name = ?", (name,)).fetchone()
        return self._origins[name]

    # -- writing ----------------------------------------------------------------------------------------------------------

    async def append(self, origin: str, events: Sequence[Event]) -> int:
        def work() -> int:
            number = self._origins.get(origin)
            if number is None:
                raise UsageError(
                    "not an origin of this side", got=origin, expected=", ".join(self._origins) or "one from own()"
                )
            self._db.execute("BEGIN IMMEDIATE")
            last = self._span(number)[1]
            self._insert(number, (e._replace(sequence=n) for n, e in enumerate(events, last + 1)), "")
            self._db.execute("COMMIT")
            return last + len(events)

        return await self._do(work)

    async def keep(self, origin: str, events: Sequence[Event], *, system: str = "", prototype: bool = False) -> int:
        def work() -> int:
            self._db.execute("BEGIN IMMEDIATE")
            number = self._origins.get(origin)
            if number is None:
                number = self._add_origin(origin, own=False, system=system, prototype=prototype)
            if system and origin not in self._whose:
                self._db.execute("UPDATE origin SET system = ? WHERE id = ? AND system = ''", (system, number))
            new = self._insert(number, events, "OR IGNORE")
            self._db.execute("COMMIT")
            self._whose.add(origin)
            return new

        return await self._do(work)

    def _insert(self, origin: int, events: Iterable[Event], how: str) -> int:
        names = self._names
        rows = [
            (origin, sequence, t_ms, kind, names.get(name) or self._name(name), value, quality, reason)
            for sequence, t_ms, kind, name, value, quality, reason in events
        ]
        return self._db.executemany(f"INSERT {how} INTO event VALUES (?, ?, ?, ?, ?, ?, ?, ?)", rows).rowcount

    def _name(self, text: str) -> int:
        if len(self._names) >= NAMES_MAX:
            raise StoreFull("too many names of tags", where=str(self.path), expected=f"at most {NAMES_MAX}", got=text)
        (number,) = self._db.execute(
            "INSERT INTO event_name (text) VALUES (?) ON CONFLICT (text) DO UPDATE SET text = text RETURNING id",
            (text,),
        ).fetchone()
        self._names[text] = number
        self._texts[number] = text
        return int(number)

    # -- reading ----------------------------------------------------------------------------------------------------------

    def _span(self, origin: int) -> tuple[int, int]:
        first, last = self._db.execute(
            "SELECT min(sequence), max(sequence) FROM event WHERE origin = ?", (origin,)
        ).fetchone()
        (gone,) = self._db.execute("SELECT max(last) FROM lost WHERE origin = ?", (origin,)).fetchone()
        if last is None:
            return (gone + 1, gone) if gone else (1, 0)
        return first, max(last, gone or 0)

    async def span(self, origin: str) -> tuple[int, int]:
        return await self._do(lambda: self._span(self._origins.get(origin, 0)))

    async def gaps(self, origin: str) -> list[tuple[int, int]]:
        def work() -> list[tuple[int, int]]:
            number = self._origins.get(origin, 0)
            holes = self._db.execute(
                "SELECT previous + 1, sequence - 1 FROM (SELECT sequence, lag(sequence, 1, 0) OVER (ORDER BY sequence) previous"
                " FROM event WHERE origin = ?) WHERE sequence > previous + 1",
                (number,),
            ).fetchall()
            lost = self._db.execute("SELECT first, last FROM lost WHERE origin = ?", (number,)).fetchall()
            return without(holes, lost)

        return await self._do(work)

    async def read(self, origin: str, first: int, limit: int) -> list[Event]:
        def work() -> list[Event]:
            return self._events("sequence >= ?", (self._origins.get(origin, 0), first), limit)

        return await self._do(work)

    async def replay(self, origin: str, since_ms: int, until_ms: int) -> AsyncIterator[list[Event]]:
        first = 0
        while True:
            where = "sequence > ? AND t_ms >= ? AND t_ms < ?"
            key = (self._origins.get(origin, 0), first, since_ms, until_ms)
            block = await self._do(lambda k=key, w=where: self._events(w, k, BLOCK))  # type: ignore[misc]
            if not block:
                return
            first = block[-1].sequence
            yield block

    def _events(self, where: str, key: tuple[int, ...], limit: int) -> list[Event]:
        rows = self._db.execute(
            f"SELECT {_COLUMNS} FROM event WHERE origin = ? AND {where} ORDER BY sequence LIMIT ?", (*key, limit)
        ).fetchall()
        texts = self._texts
        make = Event._make
        return [
            make((sequence, t_ms, kind, texts.get(name) or self._text(name), value, quality, reason))
            for sequence, t_ms, kind, name, value, quality, reason in rows
        ]

    def _text(self, number: int) -> str:
        """Return the event name with this number, which another process added. Raises `FileInvalid` if it has no such row."""
        row = self._db.execute("SELECT text FROM event_name WHERE id = ?", (number,)).fetchone()
        if row is None:
            raise FileInvalid(f"damaged: events refer to name {number}, which does not exist", path=str(self.path))
        self._texts[number] = str(row[0])
        return str(row[0])

    # -- bounds -----------------------------------------------------------------------------------------------------------

    async def note_lost(self, origin: str, first: int, last: int) -> None:
        def work() -> None:
            self._db.execute("BEGIN IMMEDIATE")
            number = self._origins.get(origin) or self._add_origin(origin, own=False, system="", prototype=False)
            self._lose(number, first, last)
            self._db.execute("COMMIT")

        await self._do(work)

    def _lose(self, origin: int, first: int, last: int) -> None:
        known = self._db.execute("SELECT first, last FROM lost WHERE origin = ?", (origin,)).fetchall()
        self._db.execute("DELETE FROM lost WHERE origin = ?", (origin,))
        self._db.executemany(
            "INSERT INTO lost VALUES (?, ?, ?)", [(origin, a, b) for a, b in merged([*known, (first, last)])]
        )

    async def forget(self, origin: str, through: int) -> int:
        def work() -> int:
            number = self._origins.get(origin, 0)
            self._db.execute("BEGIN IMMEDIATE")
            done = self._db.execute("DELETE FROM event WHERE origin = ? AND sequence <= ?", (number, through)).rowcount
            if done:
                self._lose(number, 1, through)
            self._db.execute("COMMIT")
            return done

        return await self._do(work)

    def room_bytes(self) -> int | None:
        try:
            stat = os.statvfs(self.path.parent)
            used = self.path.stat().st_size
        except OSError:
            return None
        free = stat.f_bavail * stat.f_frsize
        return min(free, max(0, self._max_bytes - used)) if self._max_bytes else free

    async def aclose(self) -> None:
        await self._offload(self._db.close)
        if self._thread is not None:
            self._thread.shutdown()
