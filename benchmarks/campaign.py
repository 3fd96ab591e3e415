#!/usr/bin/env python3
"""The efficiency of a campaign on two workers, and the figures from which benchmarks/campaign_cost.py computes large campaigns.

    benchmarks/campaign.py [--pairs 3] [--quick] [--as-shipped]

The same seeds of the same system run on one worker process and on two, in turn. The efficiency is the speed on two workers
divided by twice the speed on one: 1 if the second worker costs nothing. The start of the worker processes is part of both
times. The system is that of benchmarks/virtual_run.py with everything each second, or with --as-shipped the observatory with its
own periods, in shorter runs.
"""

from __future__ import annotations

import argparse
import pickle
import resource
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import NamedTuple

import msgspec
from peers import Goals
from virtual_run import CASES, SHIPPED, system

from fieldtwin.run.campaigns.ledger import entry_of
from fieldtwin.run.campaigns.many_seeds import SeedResult, run_seed
from fieldtwin.run.processes.workers import Workers
from fieldtwin.run.virtual.run import VirtualOptions

GOAL = 0.9
CASE = "each second, scan 100 ms"


class Campaign(NamedTuple):
    """One campaign: wall time and CPU time of its workers, in seconds, and its results."""

    wall_s: float
    cpu_s: float
    results: list[SeedResult]


def campaign(path: Path, seconds: float, seeds: int, workers: int) -> Campaign:
    """Run the seeds on this number of worker processes."""
    before, began = _children_cpu_s(), time.perf_counter()
    with Workers(workers) as pool:
        waiting = [pool.submit(run_seed, VirtualOptions(str(path), seconds, seed=seed)) for seed in range(1, seeds + 1)]
        results = [future.result() for future in waiting]
    return Campaign(time.perf_counter() - began, _children_cpu_s() - before, results)


def _children_cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="one pair of short runs")
    parser.add_argument("--as-shipped", action="store_true", help="the observatory with its own periods")
    options = parser.parse_args()
    pairs, seconds, seeds = (1, 300.0, 4) if options.quick else (options.pairs, 3600.0, 8)
    if options.as_shipped:
        seconds /= 10
    scan, sensor, mailbox, node, _, _ = CASES[CASE]
    goals = Goals()
    efficiencies, cpu_s, results = [], [], list[SeedResult]()
    with tempfile.TemporaryDirectory() as folder:
        path = SHIPPED / "observatory.yaml" if options.as_shipped else system(Path(folder), scan, sensor, mailbox, node)
        for number in range(pairs):
            of = {n: campaign(path, seconds, seeds, n) for n in ((1, 2) if number % 2 == 0 else (2, 1))}
            assert of[1].results == of[2].results, "the same seeds gave different results"
            efficiencies.append(of[1].wall_s / (2 * of[2].wall_s))
            cpu_s += [one.cpu_s / (seeds * seconds / 3600) for one in of.values()]
            results = of[2].results
            print(f"  one worker {of[1].wall_s:.1f} s, two {of[2].wall_s:.1f} s: efficiency {efficiencies[-1]:.2f}")
    entry = entry_of("0" * 16, seconds / 3600, results[0], "observatory")
    print(f"  CPU time of a virtual hour       {median(cpu_s):8.2f} s")
    print(f"  a line of the ledger             {len(msgspec.json.encode(entry)) + 1:8d} bytes")
    print(f"  a result between processes       {len(pickle.dumps(results[0])):8d} bytes")
    print(
        f"  largest worker                   {resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024 / 1e6:8.0f} MB"
    )
    goals.least("campaign, efficiency of two workers", median(efficiencies), GOAL)
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
