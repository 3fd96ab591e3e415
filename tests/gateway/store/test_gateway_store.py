"""Stored data of a gateway: the tag table with its journal, and the exchange log through crashes and full disks."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.errors import FileInvalid, Unreachable
from fieldtwin.gateway.core.values import NEVER, Quality, Reason, TagValue
from fieldtwin.gateway.runtime import tags as tags_module
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.store import exchange_log
from fieldtwin.gateway.store.exchange_log import ExchangeLog


class Hands:
    """A clock that the test sets."""

    def __init__(self) -> None:
        self.now_ns = 1_000

    def monotonic_ns(self) -> int:
        return self.now_ns

    def utc_ns(self) -> int:
        return self.now_ns

    async def sleep_until_ns(self, deadline_ns: int) -> None:
        self.now_ns = max(self.now_ns, deadline_ns)


def good(value: float, t_ns: int, raw: bytes = b"\1") -> TagValue:
    return TagValue(value, Quality.GOOD, Reason.NONE, t_ns, raw)


# -- tags ---------------------------------------------------------------------------------------------------------------


def test_a_value_that_is_not_refreshed_becomes_stale_and_keeps_its_age() -> None:
    clock = Hands()
    table = TagTable(clock)
    table.declare(["d.x"], 100)
    table.declare(["d.serial"], None)
    assert table.current("d.x", 0) == NEVER
    table.put("d.x", good(5, 900))
    table.put("d.serial", good(7, 900))
    limit = 1_000 + 100 * NS_PER_MS
    assert table.current("d.x", limit).good
    late = table.current("d.x", limit + 1)
    assert (late.quality, late.reason, late.value, late.t_ns) == (Quality.BAD, Reason.STALE, 5, 900)
    assert table.current("d.serial", limit * 1000).good  # read once: it does not become stale
    clock.now_ns = limit
    table.put("d.x", good(5, 900))  # the same old sample, seen again
    assert table.current("d.x", limit + 1).good


def test_a_bad_tag_keeps_its_last_value_and_gives_the_newest_reason() -> None:
    table = TagTable(Hands())
    table.put("d.x", good(5, 900))
    table.put_bad(["d.x", "d.y"], Reason.TIMEOUT)
    table.put_bad(["d.x"], Reason.UNREACHABLE)
    assert table.current("d.x", 10**15) == TagValue(5, Quality.BAD, Reason.UNREACHABLE, 900, b"\1")
    assert table.current("d.y", 0).value is None
    assert table.current("d.unknown", 0) == NEVER


def test_the_journal_holds_every_new_good_value_once() -> None:
    table = TagTable(Hands())
    first, second = good(1, 10), good(2, 20, b"\2")
    for value in (first, first, replace(second, quality=Quality.UNCERTAIN), second, second):
        table.put("d.x", value)
    assert [(e.number, e.value) for e in table.journal_since(0)] == [(1, 1), (2, 2)]
    assert [e.number for e in table.journal_since(1)] == [2]
    assert table.journal_since(2) == []
    table.put_bad(["d.x"], Reason.TIMEOUT)
    table.put("d.x", second)  # good again: published again
    assert table.published == 3


def test_the_journal_is_bounded_and_counts_its_losses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tags_module, "JOURNAL", 10)
    table = TagTable(Hands())
    for i in range(1, 26):
        table.put("d.x", good(i, i))
    assert table.journal_dropped == 15
    assert [e.number for e in table.journal_since(0)] == list(range(16, 26))


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 5), st.sampled_from(Quality)), max_size=60))
def test_fetching_in_pieces_loses_and_repeats_nothing(puts: list[tuple[str, int, Quality]]) -> None:
    table = TagTable(Hands())
    fetched, number = [], 0
    for i, (name, value, quality) in enumerate(puts):
        table.put(name, TagValue(value, quality, Reason.NONE, value, bytes([value])))
        if i % 3 == 0:
            new = table.journal_since(number)
            fetched += new
            number = new[-1].number if new else number
    fetched += table.journal_since(number)
    assert [e.number for e in fetched] == list(range(1, table.published + 1))


# -- the exchange log ---------------------------------------------------------------------------------------------------


def rows_of(path: Path) -> list[tuple[int, str, int, int, bytes]]:
    with closing(sqlite3.connect(path)) as db:
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        return list(db.execute("SELECT run, tag, sequence, t_ns, payload FROM exchange ORDER BY id"))


def test_rows_are_kept_in_order_with_their_run(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    for run in (1, 2):
        log = ExchangeLog(path, system="obs", prototype=run == 1)
        t_ns = 100 * run
        log.append([("relay.log", 1, t_ns, b"a"), ("relay.log", 2, t_ns, b"a")])  # duplicates are two exchanges
        assert log.flush() == 2
        assert log.flush() == 0
        log.append([("relay.log", 3, t_ns + 2, b"\0c")])
        log.close()  # flushes what is left
        assert log.stored == 3
    assert rows_of(path) == [
        (run, "relay.log", n, 100 * run + t, p)
        for run in (1, 2)
        for n, t, p in ((1, 0, b"a"), (2, 0, b"a"), (3, 2, b"\0c"))
    ]
    with closing(sqlite3.connect(path)) as db:
        assert db.execute("SELECT system, prototype FROM run").fetchall() == [("obs", 1), ("obs", 0)]


def test_records_of_a_predecessor_that_the_plc_never_got_are_stored_once(tmp_path: Path) -> None:
    rows = [("relay.log", n, n, b"x") for n in range(1, 6)]
    log = ExchangeLog(tmp_path / "s", system="obs", prototype=True)
    log.append(rows[:3])
    assert (log.pending("relay.log"), log.pending("other.log")) == (3, 0)
    log.flush()
    assert log.pending("relay.log") == 0
    log.close()
    log = ExchangeLog(tmp_path / "s", system="obs", prototype=True)
    log.append(rows)  # none of them was reported to the PLC
    assert log.pending("relay.log") == 2
    log.close()
    assert [row[2] for row in rows_of(tmp_path / "s")] == [1, 2, 3, 4, 5]


def test_a_store_of_a_newer_version_and_a_file_that_is_not_a_store_are_refused(tmp_path: Path) -> None:
    newer = tmp_path / "newer.sqlite"
    with closing(sqlite3.connect(newer)) as db:
        db.execute("PRAGMA user_version=99")
    with pytest.raises(FileInvalid, match="newer fieldtwin") as told:
        ExchangeLog(newer, system="obs", prototype=True)
    assert told.value.got == "99"
    none = tmp_path / "none.sqlite"
    none.write_bytes(b"this is a text file, and long enough to be looked into\n" * 40)
    with pytest.raises(FileInvalid, match="not a store of fieldtwin"):
        ExchangeLog(none, system="obs", prototype=True)
    assert none.read_bytes().startswith(b"this is a text file")
    with pytest.raises((FileInvalid, Unreachable)):
        ExchangeLog(tmp_path / "no" / "store.sqlite", system="obs", prototype=True)


def test_a_full_queue_drops_its_oldest_and_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exchange_log, "QUEUE", 5)
    log = ExchangeLog(tmp_path / "s", system="obs", prototype=True)
    log.append([("t", n, n, b"") for n in range(8)])
    assert log.dropped == 3
    log.close()
    assert [row[2] for row in rows_of(tmp_path / "s")] == [3, 4, 5, 6, 7]


def test_a_disk_that_refuses_loses_nothing(tmp_path: Path) -> None:
    """A different process holds the database: the rows stay queued, in order, and are written when it is released."""
    path = tmp_path / "s"
    log = ExchangeLog(path, system="obs", prototype=True)
    log._db.execute("PRAGMA busy_timeout=20")
    log.append([("t", 1, 1, b"a"), ("t", 2, 2, b"b")])
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(Unreachable, match="cannot write the exchange log"):
            log.flush()
        log.append([("t", 3, 3, b"c")])
        other.execute("ROLLBACK")
    assert log.flush() == 3
    log.close()
    assert [row[2] for row in rows_of(path)] == [1, 2, 3]


CRASH = """
import os, signal, sys
from pathlib import Path
from fieldtwin.gateway.store.exchange_log import ExchangeLog
log = ExchangeLog(Path(sys.argv[1]), system="obs", prototype=True)
for n in range(1, 1001):
    log.append([("t", n, n, bytes(100))])
    if n % 100 == 0:
        log.flush()
    if n == 950:
        log._db.execute("BEGIN")
        log._db.execute("INSERT INTO exchange (run, tag, sequence, t_ns, payload) VALUES (1, 't', 951, 1, x'00')")
        os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_process_leaves_whole_batches(tmp_path: Path) -> None:
    path = tmp_path / "s"
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[3])}
    ended = subprocess.run([sys.executable, "-c", CRASH, str(path)], env=environment, check=False, timeout=30)
    assert ended.returncode == -signal.SIGKILL
    assert [row[2] for row in rows_of(path)] == list(range(1, 901))
    log = ExchangeLog(path, system="obs", prototype=True)  # and the next run continues
    log.close()
