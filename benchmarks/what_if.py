#!/usr/bin/env python3
"""The duration of the answer to a what-if query: 6 hours of the observatory at a scan of 100 ms, forked from a state.

    benchmarks/what_if.py [--runs 3] [--quick]

The system is that of benchmarks/virtual_run.py with everything each second; its sensor samples each second and its responses
are sent by the modem. The peer is a run in virtual time of the same system in standby, traced, hashed and checked, in the same
process. Results are medians; the exit status is 1 if the goal is missed.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from statistics import median

from peers import Goals
from virtual_run import CASES, faster, system

from fieldtwin.run.what_if.fork import Fork, answer
from fieldtwin.run.what_if.last_known import of_period
from fieldtwin.run.what_if.plan import WhatIfPlan
from fieldtwin.run.what_if.state import KnownState

HORIZON_S = 6 * 3600.0
GOAL_S = 25.0


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="half an hour ahead, once")
    options = parser.parse_args()
    runs, horizon_s = (1, HORIZON_S / 12) if options.quick else (options.runs, HORIZON_S)
    scan, sensor, mailbox, node, _, _ = CASES["each second, scan 100 ms"]
    state = KnownState({"ctd.pressure": 250.0}, {"relay": of_period(1)})
    goals = Goals()
    took: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        path = system(Path(folder), scan, sensor, mailbox, node)
        traced = []
        for _ in range(runs):
            outcome = answer(
                Fork(str(path), state, horizon_s), WhatIfPlan("ahead", require=("relay.state == 'ACTIVE'",))
            )
            assert outcome.met, outcome.described()
            took.append(outcome.took_s)
            traced.append(faster(path, 600.0)[0])
    seconds = median(took) * HORIZON_S / horizon_s
    print(
        f"6 h ahead, sampling each second: {seconds:.1f} s, {HORIZON_S / seconds:.0f} times real time; "
        f"a run in standby, traced and judged: {median(traced):.0f} times"
    )
    goals.most("what-if, 6 h of the observatory at 100 ms", seconds, GOAL_S, "s")
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
