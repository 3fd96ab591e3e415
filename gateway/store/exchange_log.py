"""The exchange log: the control logic's dataLog, kept in SQLite.

The PLC logs what it exchanged while its period was positive (SPEC ruling 1) and sends each record through the process image;
here they are stored in order, duplicates kept. Rows are committed in batches, off the event loop's critical path: `append`
only queues, `flush` writes, and the queue has a bound whose overflow is counted.
"""

from __future__ import annotations

import sqlite3
from collections import deque
from pathlib import Path

from gateway.core.errors import FileInvalid, Unreachable
from gateway.store.schema import migrate, refuse_newer

QUEUE = 10_000


class ExchangeLog:
    """One database file. `dropped` counts rows that did not fit the queue."""

    def __init__(self, path: Path, *, system: str, prototype: bool) -> None:
        self._path = path
        self._queue: deque[tuple[str, int, int, bytes]] = deque()
        self.stored = 0
        self.dropped = 0
        try:
            self._db = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
            try:
                self._begin(system, prototype)
            except BaseException:
                self._db.close()
                raise
        except sqlite3.DatabaseError as e:
            raise FileInvalid(
                f"not a store of ours: {e}", path=str(path), hint="move it away; a new one is made"
            ) from e

    def _begin(self, system: str, prototype: bool) -> None:
        refuse_newer(self._db, self._path)
        self._db.execute("PRAGMA journal_mode=WAL")
        migrate(self._db, self._path)
        self._db.execute("INSERT INTO run (system, prototype) VALUES (?, ?)", (system, prototype))
        self._run = self._db.execute("SELECT max(id) FROM run").fetchone()[0]

    def append(self, rows: list[tuple[str, int, int, bytes]]) -> None:
        """Queue rows of (tag, sequence, monotonic ns, payload)."""
        for row in rows:
            if len(self._queue) >= QUEUE:
                self._queue.popleft()
                self.dropped += 1
            self._queue.append(row)

    def flush(self) -> int:
        """Write what is queued in one transaction; how many rows. Raises `Unreachable` when the disk refuses, keeping them."""
        rows = [self._queue.popleft() for _ in range(len(self._queue))]
        if not rows:
            return 0
        try:
            with self._db:
                self._db.execute("BEGIN")
                self._db.executemany(
                    "INSERT INTO exchange (run, tag, sequence, t_ns, payload) VALUES (?, ?, ?, ?, ?)",
                    [(self._run, *row) for row in rows],
                )
        except sqlite3.OperationalError as e:
            self._queue.extendleft(reversed(rows))
            raise Unreachable(f"cannot write the exchange log: {e}", where=str(self._path)) from e
        self.stored += len(rows)
        return len(rows)

    def close(self) -> None:
        """Flush and close."""
        try:
            self.flush()
        finally:
            self._db.close()
