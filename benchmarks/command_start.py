#!/usr/bin/env python3
"""The start of commands, against `python -c pass`: the delay of shell completion, and the CPU time of each command in a script.

    benchmarks/command_start.py [--runs 20] [--quick]

All commands alternate; the results are medians. CPU times include the processes that a command starts. Files of a first run, such
as compiled modules and the tables of the parser, exist. The exit status is 1 if the goal is missed.
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
TANK = "examples/first-bug/tank.yaml"
COMMANDS = (
    "--version",
    "--help",
    "plc check examples/first-bug/fill.st",
    f"plc check {TANK}",
    f"run {TANK} --prototype --for 1s",
    f"simulate {TANK} --for 1s",
    "test examples/first-bug/cycle.scenario.yaml",
)


def took_ms(*arguments: str) -> tuple[float, float]:
    """Return the duration and the CPU time of one start, in milliseconds."""
    began = time.perf_counter()
    process = subprocess.Popen(
        [python(), *arguments],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, arguments)
    return (time.perf_counter() - began) * 1000, (used.ru_utime + used.ru_stime) * 1000


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--quick", action="store_true", help="5 runs")
    options = parser.parse_args()
    bare: list[tuple[float, float]] = []
    ours: dict[str, list[tuple[float, float]]] = {command: [] for command in COMMANDS}
    for command in COMMANDS:  # the first start writes compiled modules
        took_ms("-m", "fieldtwin", *command.split())
    for _ in range(5 if options.quick else options.runs):
        bare.append(took_ms("-c", "pass"))
        for command, results in ours.items():
            results.append(took_ms("-m", "fieldtwin", *command.split()))
    bare_cpu = [cpu for _, cpu in bare]
    print(f"{'CPU ms, median':<58}{median(bare_cpu):>7.0f} python -c pass")
    for command, results in ours.items():
        cpu = [each for _, each in results]
        print(f"fieldtwin {command:<48}{median(cpu):>7.0f}, ratio {ratio(cpu, bare_cpu):.1f}")
    version = [duration for duration, _ in ours["--version"]]
    print(
        f"ms, median: python -c pass {median([each for each, _ in bare]):.0f}, fieldtwin --version {median(version):.0f}\n"
    )
    goals = Goals()
    goals.most("fieldtwin --version", median(version), GOAL_MS, "ms")
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
