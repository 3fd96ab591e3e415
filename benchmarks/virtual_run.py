#!/usr/bin/env python3
"""The speed of a whole prototype in virtual time, relative to real time: gateway, PLC and emulators, unmodified.

    benchmarks/virtual_run.py [--runs 3] [--quick]

The observatory with its sensor polled each second, its mailbox each 500 ms, TPDO and heartbeat each second: with a scan of
100 ms, with one of 10 ms, and with everything at 100 ms; and as it is shipped. Everything is traced and hashed, and every
value that is published as good is compared with the value of its device. The peer is the wall clock: 1. For scale, the table
also shows the same loop with only two tasks that wake in each scan, measured after each run, and the cost of a virtual second
in exchanges of pymodbus's client and server over its null modem. These two ratios change less from one computer to another
than the speed does. Results are medians; the exit status is 1 if a goal is missed.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from modbus_codec import pymodbus_null_modem
from peers import Goals

from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ROOT / "profiles" / "systems"
AS_SHIPPED = "as shipped, scan 10 ms"
SHIPPED_SCAN_MS = 10
SHIPPED_S = 600.0
MOST_LOOPS = 20.0
"""The goal for the shipped system: its time, divided by that of the loop alone."""
EXCHANGES = 1000
CASES = {
    "each second, scan 100 ms": (100, 1000, 500, 1000, 3600.0, 1000.0),
    "each second, scan 10 ms": (10, 1000, 500, 1000, 600.0, 150.0),
    "everything at 100 ms": (100, 100, 100, 100, 600.0, 300.0),
}
"""Scan, sensor, mailbox, TPDO and heartbeat in ms; virtual seconds; the goal."""


def system(folder: Path, scan: int, sensor: int, mailbox: int, node: int) -> Path:
    """The shipped system file with other periods; everything else is as shipped."""
    text = (SHIPPED / "observatory.yaml").read_text()
    for old, new in (
        ("cycle_ms: 10", f"cycle_ms: {scan}"),
        ("{values: {every_ms: 500}, status: {every_ms: 1000}}", f"{{values: {{every_ms: {sensor}}}}}"),
        ("stale_after_ms: 1500", "stale_after_ms: 3500"),
        (
            "heartbeat: {producer_ms: 500, consumer_ms: 1500}",
            f"heartbeat: {{producer_ms: {node}, consumer_ms: {3 * node}}}",
        ),
        ("event_ms: 100}", f"event_ms: {node}}}"),
        ("stale_after_ms: 500\n", "stale_after_ms: 3500\n"),
        ("{inbox: {every_ms: 200}, status: {every_ms: 2000}}", f"{{inbox: {{every_ms: {mailbox}}}}}"),
    ):
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / "observatory.yaml"
    path.write_text(text)
    (folder / "observatory.prototype.yaml").write_text((SHIPPED / "observatory.prototype.yaml").read_text())
    return path


def faster(path: Path, seconds: float) -> tuple[float, str]:
    """Run once; return the speed relative to real time, and the hash of the trace."""
    run = VirtualRun(VirtualOptions(str(path), seconds, seed=1))
    began = time.perf_counter()
    run.run()
    took = time.perf_counter() - began
    summary = run.summary()
    assert summary["published"]["checked"], summary
    assert summary["ok"], summary["errors"]
    return seconds / took, summary["trace"]["sha256"]


def idle(scan_ms: int, seconds: float) -> float:
    """The loop alone: two tasks that wake in each scan."""
    loop = VirtualLoop()
    clock = VirtualClock(loop)

    async def task() -> None:
        for _ in range(int(seconds * 1000 / scan_ms)):
            await clock.sleep_until_ns(loop.now_ns + scan_ms * 1_000_000)

    async def main() -> None:
        await asyncio.gather(task(), task())

    began = time.perf_counter()
    loop.run_until_complete(main())
    return seconds / (time.perf_counter() - began)


def measure(path: Path, scan_ms: int, seconds: float, runs: int) -> tuple[float, float, float, str]:
    """Return the speed, that of the loop alone, exchanges of the null modem per virtual second, and the hash of the trace."""
    speeds, alone, exchanges, digests = [], [], [], set()
    for _ in range(runs):
        speed, digest = faster(path, seconds)
        speeds.append(speed)
        digests.add(digest)
        alone.append(idle(scan_ms, seconds))
        exchanges.append(EXCHANGES / speed / pymodbus_null_modem("mbap", 10, EXCHANGES))
    assert len(digests) == 1, "the same seed gave different traces"
    return median(speeds), median(alone), median(exchanges), digests.pop()


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="one short run each")
    options = parser.parse_args()
    goals = Goals()
    runs, shorter = (1, 5) if options.quick else (options.runs, 1)
    print("times as fast as time                 median    loop alone    exchanges/s    trace")
    for name, (scan, sensor, mailbox, node, seconds, goal) in CASES.items():
        with tempfile.TemporaryDirectory() as folder:
            path = system(Path(folder), scan, sensor, mailbox, node)
            speed, alone, exchanges, digest = measure(path, scan, seconds / shorter, runs)
        print(f"  {name:<32} {speed:>9.0f}x {alone:>12.0f}x {exchanges:>13.0f}    {digest[:12]}")
        goals.least(f"virtual, {name}", speed, goal, "times as fast as time")
    path = SHIPPED / "observatory.yaml"
    speed, alone, exchanges, digest = measure(path, SHIPPED_SCAN_MS, SHIPPED_S / shorter, runs)
    print(f"  {AS_SHIPPED:<32} {speed:>9.0f}x {alone:>12.0f}x {exchanges:>13.0f}    {digest[:12]}")
    goals.most(f"virtual, {AS_SHIPPED}", alone / speed, MOST_LOOPS, "times the time of the loop alone")
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
