#!/usr/bin/env python3
"""Knowledge in SQLite: how many events per second are written durably, and how long the replay of a day takes.

    benchmarks/knowledge.py [--runs 3] [--seconds 4] [--day-rate 10] [--quick]

A writer offers events as a run does, and the measurement ends when the last of them is on disk (synchronous=FULL). The peer is
sqlite3 itself with the same rows in the same batches and settings, without names, numbers or a queue. A day is 864,000 events:
ten a second. Runs are interleaved; times are medians. The exit status is 1 if a goal is missed.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import sqlite3
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path
from statistics import median

from peers import Goals, ratio

from fieldtwin.gateway.store.event import Event
from fieldtwin.gateway.store.sqlite_knowledge import SqliteKnowledge
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.model.knowledge import BATCH, KnowledgeWriter, known_at

WRITES_PER_S = 50_000
REPLAY_S = 2.0
TAGS = [f"ctd.tag{n}" for n in range(40)]


def made(count: int) -> list[Event]:
    return [Event(0, 1_790_000_000_000 + i * 100, 0, TAGS[i % len(TAGS)], i / 8) for i in range(count)]


async def write(path: Path, events: list[Event]) -> float:
    store = await SqliteKnowledge.open(path)
    origin = await store.own("plant", system="benchmark", prototype=True, log="aa")
    writer = KnowledgeWriter(store, origin, WallClock(), capacity=len(events))
    began = time.perf_counter()
    for event in events:
        writer.observe(event)
    await writer.flush()
    took = time.perf_counter() - began
    await store.aclose()
    return took


def write_plain(path: Path, events: list[Event]) -> float:
    rows = [(1, i, e.t_ms, 0, i % 40, e.value, 0, 0) for i, e in enumerate(events, 1)]
    with closing(sqlite3.connect(path, isolation_level=None)) as db:
        db.execute("PRAGMA journal_mode=WAL")
        db.execute("PRAGMA synchronous=FULL")
        db.execute("CREATE TABLE event (a INT, b INT, c, d, e, f, g, h, PRIMARY KEY (a, b)) WITHOUT ROWID")
        began = time.perf_counter()
        for at in range(0, len(rows), BATCH):
            db.execute("BEGIN")
            db.executemany("INSERT INTO event VALUES (?, ?, ?, ?, ?, ?, ?, ?)", rows[at : at + BATCH])
            db.execute("COMMIT")
        return time.perf_counter() - began


async def replay(path: Path, count: int) -> float:
    store = await SqliteKnowledge.open(path)
    began = time.perf_counter()
    known = await known_at(store.replay("plant:aa", 0, 1 << 60))
    took = time.perf_counter() - began
    await store.aclose()
    assert (known.events, len(known.latest)) == (count, len(TAGS))
    return took


def replay_plain(path: Path, count: int) -> float:
    with closing(sqlite3.connect(path)) as db:
        began = time.perf_counter()
        rows = db.execute("SELECT b, c, d, e, f, g, h FROM event WHERE a = 1 ORDER BY b").fetchall()
        took = time.perf_counter() - began
    assert len(rows) == count
    return took


def main() -> int:
    parser = argparse.ArgumentParser(description="knowledge: writing, replaying")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--seconds", type=int, default=4, help="so much of the promised rate is written in a run")
    parser.add_argument("--day-rate", type=int, default=10, help="events a second of the day that is replayed")
    parser.add_argument("--quick", action="store_true", help="few events, one run: does it work at all?")
    options = parser.parse_args()
    runs = 1 if options.quick else options.runs
    count = 20_000 if options.quick else WRITES_PER_S * options.seconds
    day = 20_000 if options.quick else 86_400 * options.day_rate
    times: dict[str, list[float]] = {"write": [], "write, sqlite3": [], "replay": [], "replay, sqlite3": []}
    with tempfile.TemporaryDirectory(prefix="fieldtwin-bench-") as folder:
        whole_day, plain_day = Path(folder) / "day.db", Path(folder) / "plain.db"
        events = made(day)
        asyncio.run(write(whole_day, events))
        write_plain(plain_day, events)
        for n in range(runs):
            gc.collect()
            times["write"].append(asyncio.run(write(Path(folder) / f"w{n}.db", events[:count])))
            times["write, sqlite3"].append(write_plain(Path(folder) / f"p{n}.db", events[:count]))
            times["replay"].append(asyncio.run(replay(whole_day, day)))
            times["replay, sqlite3"].append(replay_plain(plain_day, day))
    print(f"{count} events written, {day} replayed, {runs} runs")
    for name, of in (("write", count), ("write, sqlite3", count), ("replay", day), ("replay, sqlite3", day)):
        base = times.get(f"{name}, sqlite3")
        against = f"   {ratio(times[name], base):.2f} of sqlite3's time" if base else ""
        print(f"{name:<16} {median(times[name]):8.2f} s   {of / median(times[name]):>10.0f}/s{against}")
    goals = Goals()
    goals.least("events written for good", count / median(times["write"]), WRITES_PER_S, "a second")
    goals.most("a day's knowledge replayed", median(times["replay"]) * 86_400 * options.day_rate / day, REPLAY_S, "s")
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
