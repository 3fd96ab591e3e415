#!/usr/bin/env python3
"""The cost of what `fieldtwin plc why` records while programs in Structured Text run: CPU time of a scan, to the same without
records.

    benchmarks/why_recording.py [--pairs 15] [--quick]

Two programs: that of `st_program.py` (100 stations, plain variables and timers), and one that does little else than move values
through arrays and structures in loops, also through VAR_IN_OUT. The runs without records
execute the same Python code before the pass that adds them (`fieldtwin.plc.st.compiler.assignments`). Both kinds of runs
alternate, in a random order inside each pair, and the median of the ratios is printed.

A scan of the PLC also reads the values that decided, for each tag that has changed. It is to the same scan without records,
which has no statement for them.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from statistics import median

from st_program import st_text

from fieldtwin.plc.binding import BoundProgram, image_for
from fieldtwin.plc.cycle.scan import Scan
from fieldtwin.plc.program import ScanInfo
from fieldtwin.plc.st.compiler import assignments
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.program import StProgram, program_class

CYCLE_NS = 10_000_000
ARRAYS = """\
TYPE Tank : STRUCT level, flow : REAL; alarms : ARRAY[1..4] OF BOOL; END_STRUCT END_TYPE
FUNCTION_BLOCK Filter
VAR_IN_OUT tank : Tank; history : ARRAY[0..49] OF REAL; END_VAR
VAR at : INT; END_VAR
  history[at] := tank.flow;
  at := (at + 1) MOD 50;
  tank.level := tank.level + 0.125 * (tank.flow - tank.level);
  tank.alarms[1] := tank.level > 80.0;
END_FUNCTION_BLOCK
PROGRAM plant
VAR
  i, tick : INT;
  tanks : ARRAY[1..50] OF Tank;
  filters : ARRAY[1..50] OF Filter;
  history : ARRAY[0..49] OF REAL;
  sorted : ARRAY[1..50] OF REAL;
END_VAR
VAR_OUTPUT most : REAL; any : BOOL; END_VAR
  tick := tick + 1;
  most := 0.0;
  any := FALSE;
  FOR i := 1 TO 50 DO
    tanks[i].flow := INT_TO_REAL((tick * i) MOD 101);
    filters[i](tank := tanks[i], history := history);
    sorted[i] := tanks[i].level;
    IF sorted[i] > most THEN
      most := sorted[i];
    END_IF
    IF tanks[i].alarms[1] THEN
      any := TRUE;
    END_IF
  END_FOR
END_PROGRAM
"""


@contextmanager
def without_records() -> Iterator[None]:
    """Compile programs without the pass that adds the records."""
    visit = assignments.Assignments.visit
    assignments.Assignments.visit = lambda self, node: node  # type: ignore[method-assign]
    try:
        yield
    finally:
        assignments.Assignments.visit = visit  # type: ignore[method-assign]


def logic_us(made: type[StProgram], scans: int) -> float:
    """Return the CPU time (us) of one execution of the program."""
    program = made()
    return _timed(lambda n: program.execute(ScanInfo(n * CYCLE_NS, n, n == 1)), scans)


def scan_us(made: type[StProgram], scans: int) -> float:
    """Return the CPU time (us) of one scan of a PLC with the program."""
    bound = BoundProgram("plant", made(), {})
    layout = image_for([bound], {})
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    scan = Scan(layout.attach(memory), [bound], 1e12)
    return _timed(lambda n: scan.execute(n * CYCLE_NS), scans)


def _timed(execute: Callable[[int], object], scans: int) -> float:
    began = time.process_time()
    for n in range(1, scans + 1):
        execute(n)
    return (time.process_time() - began) / scans * 1e6


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=15)
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args()
    pairs = 2 if given.quick else given.pairs
    texts = {"100 stations": (st_text(), 300), "arrays and structures": (ARRAYS, 1000)}
    order = random.Random(1)
    print(f"{'CPU time, median of ' + str(pairs) + ' pairs':<32} {'without':>10} {'with':>10} {'ratio':>7}")
    for name, (text, scans) in texts.items():
        with without_records():
            bare = program_class(compile_text(text, "plant.st"))
        recording = program_class(compile_text(text, "plant.st"))
        for what, measure in (("logic", logic_us), ("scan of the PLC", scan_us)):
            found: list[tuple[float, float]] = []
            for _ in range(pairs):
                both = [bare, recording]
                order.shuffle(both)
                took = {made: measure(made, scans // 10 if given.quick else scans) for made in both}
                found.append((took[bare], took[recording]))
            ratios = [with_us / without_us for without_us, with_us in found]
            times = [median(column) for column in zip(*found, strict=True)]
            print(f"{name + ': ' + what:<32} {times[0]:>7.1f} us {times[1]:>7.1f} us {median(ratios):>7.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
