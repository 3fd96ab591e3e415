#!/usr/bin/env python3
"""The virtual hours until a campaign finds each of 20 seeded bugs: with drawn faults, and with faults that coverage steers.

    benchmarks/steering.py [--campaigns 3] [--runs 250] [--jobs 2] [--quick]

The plant in `benchmarks/steering_bugs` has four programs with five bugs each, which the first comment of a program describes. A
bug is found when the variable `bug` of its program has its number. A campaign has `--runs` runs of `RUN_S` virtual seconds. A bug
that a campaign does not find counts with the virtual hours of the whole campaign. The ratio is that of drawn faults to steered
faults: above 1, steering finds the bug sooner. The figures do not depend on the speed of the computer. The benchmark has no goal,
because steering is not part of fieldtwin (decision 56).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import geometric_mean, median

from steered_choice import Fault, Planned, Steering, generations

from fieldtwin.results.trace import Trace, TraceEvent, TraceKind
from fieldtwin.run.campaigns.coverage_collector import CoverageCollector
from fieldtwin.run.processes.workers import Workers, run_all
from fieldtwin.run.virtual.fault_schedule import CALM_S, RandomFaults, random_schedule
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun, load_one

SYSTEM = Path(__file__).parent / "steering_bugs" / "plant.yaml"
PROGRAMS = ("alarms", "batch", "homing", "redundant")
BUGS = [f"{program} {number}" for program in PROGRAMS for number in range(1, 6)]
RUN_S = 600.0
FAULTS = RandomFaults(mean_s=30.0)


@dataclass(frozen=True, slots=True)
class Ended:
    """A run that has ended: the bugs that it found, and the elements of its coverage."""

    bugs: frozenset[str]
    elements: frozenset[int]


def one_run(planned: Planned) -> Ended:
    """Make one run."""
    found, collector = set[str](), CoverageCollector()

    def state(event: TraceEvent) -> None:
        program, _, variable = event.where.partition(".")
        if variable == "bug" and event.data["value"]:
            found.add(f"{program} {event.data['value']}")

    def watch(trace: Trace) -> None:
        collector.listen(trace)
        trace.listen(state, TraceKind.STATE)

    VirtualRun(VirtualOptions(str(SYSTEM), RUN_S, seed=planned.seed, faults=planned.faults)).run(watch=watch)
    return Ended(frozenset(found), collector.coverage.elements)


def campaign(numbers: range, steered: bool, workers: Workers) -> dict[str, float]:
    """Return the virtual hours after which each bug was found."""
    group = load_one(VirtualOptions(str(SYSTEM), RUN_S))

    def draw(seed: int) -> Sequence[Fault]:
        return random_schedule(group, seed, RUN_S, FAULTS)

    found: dict[str, float] = {}
    steering = Steering(draw, RUN_S - CALM_S)
    for generation in generations(numbers):
        plans = [steering.plan(n) if steered else Planned(n, n, tuple(draw(n))) for n in generation]
        for planned, ended in zip(plans, run_all(workers, one_run, plans), strict=True):
            steering.add(planned, ended.elements)
            for bug in ended.bugs:
                found.setdefault(bug, (planned.number - numbers[0] + 1) * RUN_S / 3600)
    return found


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--campaigns", type=int, default=3)
    parser.add_argument("--runs", type=int, default=250)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="one campaign of 70 runs")
    options = parser.parse_args()
    campaigns, runs = (1, 70) if options.quick else (options.campaigns, options.runs)
    limit_h, found = runs * RUN_S / 3600, dict[bool, list[dict[str, float]]]({False: [], True: []})
    with Workers(options.jobs) as workers:
        for first in range(1, campaigns * 100_000, 100_000):
            for steered in (False, True):
                ended = campaign(range(first, first + runs), steered, workers)
                found[steered].append(ended)
                print(
                    f"campaign from {first}, {'steered' if steered else 'drawn'}: {len(ended)} bugs found", flush=True
                )
    print(
        f"virtual hours until a bug is found, medians of {campaigns} campaigns of {limit_h:.1f} h, and campaigns that found it"
    )
    print("bug                 drawn         steered      ratio")
    ratios = []
    for bug in BUGS:
        drawn_h, steered_h = (median(one.get(bug, limit_h) for one in found[way]) for way in (False, True))
        count, steered_count = (sum(bug in one for one in found[way]) for way in (False, True))
        ratios.append(drawn_h / steered_h)
        print(f"{bug:<14} {drawn_h:7.1f} ({count}) {steered_h:11.1f} ({steered_count}) {ratios[-1]:10.2f}")
    print(f"geometric mean of the ratios {geometric_mean(ratios):.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
