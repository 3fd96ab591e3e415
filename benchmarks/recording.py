#!/usr/bin/env python3
"""Recordings: writing record by record, reading, and the time until an emulator answers from one. Against json.

    benchmarks/recording.py [--runs 3] [--exchanges 1000000] [--quick]

Each record is one write, so that a killed writer loses at most that one. The peer is the standard library's json over the same
lines, written through a buffered file. An exchange reads ten registers. Runs are interleaved; times are medians. The exit
status is 1 if a goal is missed.
"""

from __future__ import annotations

import argparse
import gc
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median

from peers import Goals, ratio

from fieldtwin.emulators.replay.replay import ExchangeReplay
from fieldtwin.gateway.core.files.recording import RecordedExchange, RecordingHeader, RecordingReader, RecordingWriter

WRITES_PER_S = 100_000
LOAD_S = 3.0
GOAL_OF = 1_000_000
REQUEST = bytes.fromhex("040000000a")
HEADER = RecordingHeader(version=1, device="benchmark", kind="exchanges", source="synthetic")


def exchanges(count: int) -> Iterator[RecordedExchange]:
    for i in range(count):
        yield RecordedExchange(i * 0.001, 1 + i % 4, REQUEST, b"\x04\x14" + i.to_bytes(20), 0.0123)


def write(path: Path, count: int) -> float:
    """Return the seconds to write this number of records."""
    path.unlink(missing_ok=True)
    made = list(exchanges(min(count, 10_000)))
    began = time.perf_counter()
    with RecordingWriter(path, HEADER) as writer:
        for i in range(count):
            writer.exchange(made[i % len(made)])
    return time.perf_counter() - began


def write_json(path: Path, count: int) -> float:
    made = list(exchanges(min(count, 10_000)))
    began = time.perf_counter()
    with path.open("w") as file:
        for i in range(count):
            e = made[i % len(made)]
            reply = e.reply.hex() if e.reply is not None else None
            line = {"t": e.t_s, "unit": e.unit, "req": e.request.hex(), "rep": reply, "lat": e.latency_s}
            file.write(json.dumps(line) + "\n")
    return time.perf_counter() - began


def read(path: Path) -> float:
    began = time.perf_counter()
    with RecordingReader(path) as reader:
        sum(1 for _ in reader.exchanges())
    return time.perf_counter() - began


def read_json(path: Path) -> float:
    began = time.perf_counter()
    with path.open() as file:
        next(file)
        for line in file:
            raw = json.loads(line)
            RecordedExchange(raw["t"], raw["unit"], bytes.fromhex(raw["req"]), bytes.fromhex(raw["rep"]), raw["lat"])
    return time.perf_counter() - began


def answer(path: Path) -> float:
    """Return the seconds from opening the file to the first answer from it."""
    began = time.perf_counter()
    replay = ExchangeReplay.load(path)
    assert replay.respond(1, REQUEST).reply
    return time.perf_counter() - began


def main() -> int:
    parser = argparse.ArgumentParser(description="recordings: writing, reading, answering")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--exchanges", type=int, default=GOAL_OF)
    parser.add_argument("--quick", action="store_true", help="few exchanges, one run: does it work at all?")
    options = parser.parse_args()
    count, runs = (20_000, 1) if options.quick else (options.exchanges, options.runs)
    with tempfile.TemporaryDirectory(prefix="fieldtwin-bench-") as folder:
        path, other = Path(folder) / "r.jsonl", Path(folder) / "json.jsonl"
        steps: dict[str, Callable[[], float]] = {
            "write": lambda: write(path, count),
            "write, json": lambda: write_json(other, count),
            "read": lambda: read(path),
            "read, json": lambda: read_json(path),
            "first answer": lambda: answer(path),
        }
        times: dict[str, list[float]] = {name: [] for name in steps}
        for _ in range(runs):
            for name, step in steps.items():
                gc.collect()
                times[name].append(step())
    print(f"{count} exchanges of ten registers, {runs} runs")
    for name, values in times.items():
        base = times.get(f"{name}, json")
        against = f"   {ratio(values, base):.2f} of json's time" if base else ""
        print(f"{name:<14} {median(values):8.2f} s   {count / median(values):>10.0f}/s{against}")
    goals = Goals()
    goals.least("records written to disk", count / median(times["write"]), WRITES_PER_S, "a second")
    for name in ("read", "first answer"):
        goals.most(f"{name}, for {GOAL_OF} exchanges", median(times[name]) * GOAL_OF / count, LOAD_S, "s")
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
