#!/usr/bin/env python3
"""Compute the cost of a large campaign from the figures that benchmarks/campaign.py measures.

    benchmarks/campaign_cost.py --cpu-s 1.9 [--hours 1000000] [--cores 128] [--run-hours 24] [--efficiency 0.9] ...

It measures nothing. Prints a Markdown table; docs/explanation/campaign-cost.md has those for its figures.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence


def positive(text: str) -> float:
    """Return a finite number above 0. Raises `argparse.ArgumentTypeError`."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text!r}")
    return number


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(description="Compute what a campaign costs, from figures of benchmarks/campaign.py.")
    for name, default, text in (
        ("--cpu-s", None, "CPU time of a virtual hour on one core, in seconds"),
        ("--hours", 1e6, "virtual hours of the campaign"),
        ("--cores", 128.0, "cores, each with one worker"),
        ("--run-hours", 24.0, "virtual hours of one run"),
        ("--efficiency", 0.9, "speed on all cores, divided by the number of cores times the speed on one"),
        ("--ledger-bytes", 1853.0, "length of a line of the ledger"),
        ("--unit-bytes", 2380.0, "bytes that a worker receives and returns for a run"),
        ("--worker-mb", 95.0, "memory of a worker in MB (10^6 bytes)"),
    ):
        made.add_argument(name, type=positive, default=default, required=default is None, help=text)
    return made


def table(given: argparse.Namespace) -> str:
    """Return the table."""
    runs = math.ceil(given.hours / given.run_hours)
    core_hours = given.hours * given.cpu_s / 3600 / given.efficiency
    wall_hours = core_hours / given.cores
    rows = [
        ("runs", f"{runs:,}"),
        ("core hours", f"{core_hours:,.0f}"),
        ("wall time", f"{wall_hours:,.1f} h"),
        ("wall time of one run", f"{given.run_hours * given.cpu_s / given.efficiency / 60:,.1f} min"),
        ("virtual hours per hour", f"{given.hours / wall_hours:,.0f}"),
        ("runs that end in a second", f"{runs / wall_hours / 3600:.2g}"),
        ("ledger", f"{runs * given.ledger_bytes / 1e6:,.1f} MB"),
        ("network traffic", f"{runs * given.unit_bytes / 1e6:,.1f} MB"),
        ("memory", f"{given.cores * given.worker_mb / 1e3:,.1f} GB"),
    ]
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)])


def main(words: Sequence[str] | None = None) -> None:
    print(table(parser().parse_args(words)))


if __name__ == "__main__":
    main()
