#!/usr/bin/env python3
"""The virtual hours until random and guided faults find each of 20 seeded bugs, in real runs in virtual time.

    benchmarks/steering.py [--runs 60] [--jobs 2] [--quick]

The plant in `benchmarks/steering_bugs` has four programs with five bugs each, which the first comment of a program describes. A
bug is found when the variable `bug` of its program has its number. Each of `--runs` seeds makes a run of one virtual hour with
`--faults random` and one with `--faults guided`, both with a fault in two minutes on average. The seeds are independent, so the
mean number of hours until a bug is found is the number of hours divided by the number of runs that found it. Half a run is
added to each count in the ratio, so that a bug which no run found has a ratio. A ratio above 1 means that guided faults find the
bug sooner. The figures do not depend on the speed of the computer. Goal: a geometric mean of at least 1.5.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from statistics import geometric_mean, mean

from fieldtwin.results.trace import Trace, TraceEvent, TraceKind
from fieldtwin.run.processes.workers import Workers
from fieldtwin.run.virtual.fault_schedule import RandomFaults
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun

SYSTEM = Path(__file__).parent / "steering_bugs" / "plant.yaml"
PROGRAMS = ("burner", "dosing", "pumps", "standby")
BUGS = [f"{program} {number}" for program in PROGRAMS for number in range(1, 6)]
RUN_H = 1.0
GOAL = 1.5


@dataclass(frozen=True, slots=True)
class Ended:
    """A run that has ended: the bugs that it found, and its number of faults."""

    bugs: frozenset[str]
    faults: int


def one_run(guided: bool, seed: int) -> Ended:
    """Make one run."""
    found = set[str]()

    def state(event: TraceEvent) -> None:
        program, _, variable = event.where.partition(".")
        if variable == "bug" and event.data["value"]:
            found.add(f"{program} {event.data['value']}")

    def watch(trace: Trace) -> None:
        trace.listen(state, TraceKind.STATE)

    run = VirtualRun(VirtualOptions(str(SYSTEM), RUN_H * 3600, seed=seed, random_faults=RandomFaults(guided=guided)))
    run.run(watch=watch)
    return Ended(frozenset(found), len(run.faults))


def hours(runs: int, found: int) -> str:
    """Return the mean number of virtual hours until a bug is found."""
    return f"{runs * RUN_H / found:.1f}" if found else f">{runs * RUN_H:.0f}"


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="8 runs of each kind")
    options = parser.parse_args()
    runs = 8 if options.quick else options.runs
    found: list[Counter[str]] = []
    with Workers(options.jobs) as workers:
        for guided in (False, True):
            waiting = [workers.submit(one_run, guided, seed) for seed in range(1, runs + 1)]
            ended = [future.result() for future in waiting]
            found.append(Counter(bug for one in ended for bug in one.bugs))
            word = "guided" if guided else "random"
            print(
                f"{word}: {runs} runs of {RUN_H:g} h, {mean(one.faults for one in ended):.1f} faults each", flush=True
            )
    print("virtual hours until a bug is found, and runs that found it")
    print("bug               random         guided      ratio")
    ratios = []
    for bug in BUGS:
        drawn, guided_count = (count[bug] for count in found)
        ratios.append((guided_count + 0.5) / (drawn + 0.5))
        print(
            f"{bug:<12} {hours(runs, drawn):>7} ({drawn:3}) {hours(runs, guided_count):>8} ({guided_count:3}) {ratios[-1]:10.2f}"
        )
    result = geometric_mean(ratios)
    print(f"geometric mean of the ratios {result:.2f}, goal {GOAL}")
    return 0 if result >= GOAL else 1


if __name__ == "__main__":
    sys.exit(main())
