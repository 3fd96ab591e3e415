#!/usr/bin/env python3
"""The duration of `fieldtwin --version`, against `python -c pass`: the minimum delay of shell completion and of every script.

    benchmarks/version_start.py [--runs 20] [--quick]

Both alternate; the results are medians. The exit status is 1 if the goal is missed.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from statistics import median

from peers import ROOT, Goals, python, ratio

GOAL_MS = 150.0


def took_ms(*arguments: str) -> float:
    began = time.perf_counter()
    subprocess.run(
        [python(), *arguments], check=True, stdout=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    return (time.perf_counter() - began) * 1000


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--quick", action="store_true", help="5 runs")
    options = parser.parse_args()
    ours: list[float] = []
    bare: list[float] = []
    for _ in range(5 if options.quick else options.runs):
        bare.append(took_ms("-c", "pass"))
        ours.append(took_ms("-m", "fieldtwin", "--version"))
    print(f"ms, median: python -c pass {median(bare):.0f}, fieldtwin --version {median(ours):.0f}, ", end="")
    print(f"ratio {ratio(ours, bare):.2f}\n")
    goals = Goals()
    goals.most("fieldtwin --version", median(ours), GOAL_MS, "ms")
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
