"""The exchange log: the control logic's dataLog, kept in SQLite.

While its period is positive, the PLC logs each exchanged message (paper.md, ruling 1) and sends the record through the process
image. This module stores the records in order, duplicates included. Rows are committed in batches, so that the event loop does
not wait for the disk: `append` only queues, and `flush` writes. The queue is limited, and rows that do not fit are counted.
"""

from __future__ import annotations

import sqlite3
from collections import Counter, deque
from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid, Unreachable
from fieldtwin.gateway.store.schema import migrate, refuse_newer

QUEUE = 10_000
KNOWN = 1_000
"""The number of rows at the end of the store that are compared with new rows, so that no row is stored twice.

A PLC cannot have this number of unconfirmed rows.
"""


class ExchangeLog:
    """The log in one database file. `dropped` counts rows that did not fit into the queue.

    A killed gateway process leaves neither gaps nor duplicates, because it reports to the PLC only rows that are stored
    (`pending`). The next gateway process receives the other rows again, and ignores those that were stored but not reported.
    """

    def __init__(self, path: Path, *, system: str, prototype: bool) -> None:
        self._path = path
        self._queue: deque[tuple[str, int, int, bytes]] = deque()
        self._known: set[tuple[str, int, int]] = set()
        self._pending: Counter[str] = Counter()
        self._refused = False
        self._volatile = str(path) == ":memory:"
        self.stored = 0
        self.dropped = 0
        try:
            self._db = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
            try:
                self._begin(system, prototype)
            except BaseException:
                self._db.close()
                raise
        except sqlite3.OperationalError as e:  # an error of the disk, not of the file's content
            raise Unreachable(f"cannot open the exchange log: {e}", where=str(path)) from e
        except sqlite3.DatabaseError as e:
            raise FileInvalid(
                f"not a store of fieldtwin: {e}", path=str(path), hint="move the file away; a new one is created"
            ) from e

    def _begin(self, system: str, prototype: bool) -> None:
        refuse_newer(self._db, self._path)
        self._db.execute("PRAGMA journal_mode=WAL")
        migrate(self._db, self._path)
        self._db.execute("INSERT INTO run (system, prototype) VALUES (?, ?)", (system, prototype))
        self._run = self._db.execute("SELECT max(id) FROM run").fetchone()[0]
        last = "SELECT tag, sequence, t_ns FROM exchange ORDER BY id DESC LIMIT ?"
        self._known.update(self._db.execute(last, (KNOWN,)))

    def append(self, rows: list[tuple[str, int, int, bytes]]) -> None:
        """Queue rows of (tag, sequence, monotonic ns, payload). Rows that an earlier process stored are ignored."""
        for row in rows:
            if self._known and row[:3] in self._known:
                continue
            if len(self._queue) >= QUEUE:
                self._queue.popleft()
                self.dropped += 1
            self._queue.append(row)

    @property
    def waiting(self) -> int:
        """Return the number of queued rows."""
        return len(self._queue)

    def pending(self, tag: str) -> int:
        """Return how many rows of `tag` are lost if this process is killed now, so that the PLC has to keep them.

        The result is 0 while writing to the disk fails; this object then keeps up to `QUEUE` rows, so that the PLC can continue.
        """
        if self._refused or self._volatile:
            return 0
        return self._pending[tag] + sum(row[0] == tag for row in tuple(self._queue))

    def flush(self) -> int:
        """Write the queued rows in one transaction and return their number.

        Raises `Unreachable` if the write fails; the rows stay queued.
        """
        count = len(self._queue)
        if not count:
            return 0
        # set before the rows leave the queue, so that it is never too low
        self._pending = Counter(row[0] for row in tuple(self._queue))
        rows = [self._queue.popleft() for _ in range(count)]
        try:
            with self._db:
                self._db.execute("BEGIN")
                self._db.executemany(
                    "INSERT INTO exchange (run, tag, sequence, t_ns, payload) VALUES (?, ?, ?, ?, ?)",
                    [(self._run, *row) for row in rows],
                )
        except sqlite3.OperationalError as e:
            self._refused = True
            self._queue.extendleft(reversed(rows))
            self._pending = Counter()
            raise Unreachable(f"cannot write the exchange log: {e}", where=str(self._path)) from e
        self._refused = False
        self._pending = Counter()
        self.stored += len(rows)
        return len(rows)

    def close(self) -> None:
        """Write the queued rows and close the file."""
        try:
            self.flush()
        finally:
            self._db.close()
