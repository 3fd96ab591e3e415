#!/usr/bin/env python3
"""The cost of a scan: of the observatory, of 1,000 tags with 200 function blocks, and its growth with the number of tags.

    benchmarks/plc_scan.py [--runs 5] [--quick]

In one thread, back to back: execution time without waking up, with warm caches. At one scan per 10 ms the same scan takes
several times as long on a computer with other work; that time is also shown, and is the one in `plc status`. The peer for each
figure is a plain Python loop that copies the same number of values from one list to another, in the same run: the minimum for
an interpreter. The exit status is 1 if a goal is missed.
"""

from __future__ import annotations

import argparse
import gc
import sys
import time
from statistics import median
from typing import Any

from peers import Goals

from fieldtwin.gateway.core.image.image import INPUTS, TagKind, TagSpec
from fieldtwin.gateway.core.values import Quality, TagValue
from fieldtwin.plc.binding import BoundProgram, InputBinding, image_for
from fieldtwin.plc.blocks import CTU, MS, TON
from fieldtwin.plc.cycle.scan import Scan
from fieldtwin.plc.program import Program, ScanInfo, var_input, var_output
from fieldtwin.twin.plant.physical import image_layout, programs_of
from fieldtwin.twin.site.system import load_system

GOAL_OBSERVATORY_US = 25.0
GOAL_BLOCKS_US = 1000.0
SIZES = (100, 500, 1000, 2000, 5000, 10_000)


class Rig:
    """Programs over an image in plain memory, with access to the gateway's side."""

    def __init__(self, layout: Any, programs: list[BoundProgram]) -> None:
        memory = memoryview(bytearray(layout.size))
        layout.format(memory)
        image = layout.attach(memory)
        self.row = [TagValue(1, Quality.GOOD, t_ns=1)] * len(layout.regions[0].tags)
        self.writer = image.writer(INPUTS)
        self.writer.publish(self.row, 1)
        self.scan = Scan(image, programs, 1e12)

    def scan_us(self, scans: int, every_s: float = 0.0) -> float:
        """Return the median time of a scan, one every `every_s`; every second one has new inputs."""
        took = []
        for n in range(scans):
            if n & 1:
                self.writer.publish(self.row, n + 1)
            if every_s:
                time.sleep(every_s)
            began = time.perf_counter_ns()
            self.scan.execute(n * 10 * MS)
            took.append(time.perf_counter_ns() - began)
        return median(took) / 1000


def observatory() -> Rig:
    system = load_system("observatory")
    return Rig(image_layout(system), [p.bind((str(system.path.parent),)) for p in programs_of(system)])


def many_tags(tags: int, blocks: int) -> Rig:
    """A program with half of `tags` inputs, half outputs, and `blocks` function blocks, half timers, half counters."""
    half = tags // 2
    body: dict[str, Any] = {f"i{n}": var_input(TagKind.BOOL if n % 2 else TagKind.INT) for n in range(half)}
    body |= {f"o{n}": var_output(TagKind.BOOL if n % 2 else TagKind.INT) for n in range(half)}
    timers, counters = [TON() for _ in range(blocks // 2)], [CTU() for _ in range(blocks // 2)]
    names = [(f"i{n}", f"o{n}") for n in range(half)]

    def execute(self: Any, scan: ScanInfo) -> None:
        now_ns, own = scan.now_ns, self.__dict__
        for source, target in names:
            own[target] = own[source]
        for timer in timers:
            timer(now_ns, IN=self.i1, PT=500 * MS)
        for counter in counters:
            counter(now_ns, CU=self.i1, R=False, PV=10)

    made = type("Many", (Program,), body | {"execute": execute})()
    plant = {f"d.i{n}": TagSpec(f"d.i{n}", made.variables[f"i{n}"].kind) for n in range(half)}
    bound = BoundProgram("many", made, {f"i{n}": InputBinding(f"d.i{n}") for n in range(half)})
    return Rig(image_for([bound], plant), [bound])


def copy_us(count: int, times: int) -> float:
    source, target = list(range(count)), [0] * count
    took = []
    for _ in range(times):
        began = time.perf_counter_ns()
        for n in range(count):
            target[n] = source[n]
        took.append(time.perf_counter_ns() - began)
    return median(took) / 1000


def fit(sizes: tuple[int, ...], took_us: list[float]) -> tuple[float, float, float]:
    """Least squares: us per tag, us for none, and R^2."""
    n, mean_x, mean_y = len(sizes), sum(sizes) / len(sizes), sum(took_us) / len(took_us)
    sxx = sum((x - mean_x) ** 2 for x in sizes)
    slope = sum((x - mean_x) * (y - mean_y) for x, y in zip(sizes, took_us, strict=True)) / sxx
    rest = sum((y - mean_y - slope * (x - mean_x)) ** 2 for x, y in zip(sizes, took_us, strict=True))
    total = sum((y - mean_y) ** 2 for y in took_us)
    return slope, mean_y - slope * mean_x, 1 - rest / total if n > 2 else 1.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    runs, scans = (2, 500) if options.quick else (options.runs, 3000)
    goals = Goals()
    rigs = {"observatory": observatory(), "1,000 tags, 200 blocks": many_tags(1000, 200)}
    by_size = {size: many_tags(size, 0) for size in SIZES}
    found: dict[str, list[float]] = {name: [] for name in rigs}
    loops: dict[str, list[float]] = {name: [] for name in rigs}
    sized: dict[int, list[float]] = {size: [] for size in SIZES}
    gc.collect()
    gc.freeze()
    for _ in range(runs):
        for name, rig in rigs.items():
            found[name].append(rig.scan_us(scans if name == "observatory" else scans // 5))
            loops[name].append(copy_us(len(rig.row), 200))
        for size, rig in by_size.items():
            sized[size].append(rig.scan_us(max(30, scans * 100 // size // 5)))
    print(f"{'scan':<26} {'us, median':>12}   ratio to a loop that copies as many numbers")
    for name in rigs:
        print(f"{name:<26} {median(found[name]):>12.1f}   {median(found[name]) / median(loops[name]):.0f}")
    cold = rigs["observatory"].scan_us(200, every_s=0.01)
    print(
        f"{'observatory, each 10 ms':<26} {cold:>12.1f}   {cold / median(found['observatory']):.0f} times as long as back to back"
    )
    took = [median(sized[size]) for size in SIZES]
    for size, us in zip(SIZES, took, strict=True):
        print(f"{size:>6} tags, no blocks      {us:>10.1f}   {us / size * 1000:.0f} ns a tag")
    slope, base, r2 = fit(SIZES, took)
    print(f"linear fit: {slope * 1000:.0f} ns a tag + {base:.0f} us, R^2 = {r2:.4f}\n")
    goals.most("the observatory's scan", median(found["observatory"]), GOAL_OBSERVATORY_US, "us")
    goals.most("1,000 tags with 200 blocks", median(found["1,000 tags, 200 blocks"]), GOAL_BLOCKS_US, "us")
    goals.least("cost linear in tags up to 10,000, R^2", r2, 0.99)
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
