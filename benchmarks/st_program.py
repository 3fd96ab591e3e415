#!/usr/bin/env python3
"""The cost of a scan of a Structured Text program of 2,000 lines; to the same program in C.

    benchmarks/st_program.py [--pairs 7] [--quick]

The program has 100 stations with a timer, a CASE over a state, a counter, a filter of REAL and an alarm. The same generator makes
the C program: a structure for each block and plain statements, as a compiler such as matiec writes them; no package has matiec
itself. cc compiles it with -O2. Both run the same scans; if their results differ, the benchmark fails. The time is the CPU time
of the process, without its start.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from peers import Goals, Missing, row

from fieldtwin.plc.program import ScanInfo
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.program import program_class

STATIONS = 100
CYCLE_NS = 10_000_000
GOAL = 30.0

ST_STATION = """\
  timer{n}(IN := run{n}, PT := T#50ms);
  CASE state{n} OF
    0:
      IF (tick + {n}) MOD 7 = 0 THEN
        run{n} := TRUE;
        state{n} := 1;
      END_IF
    1:
      IF timer{n}.Q THEN
        run{n} := FALSE;
        state{n} := 2;
      END_IF
    2:
      count{n} := count{n} + 1;
      state{n} := 0;
  END_CASE
  level{n} := level{n} + 0.125 * (INT_TO_REAL(count{n}) - level{n});
  IF level{n} > 20.0 OR alarm{n} AND level{n} > 10.0 THEN
    alarm{n} := TRUE;
  ELSE
    alarm{n} := FALSE;
  END_IF
"""
ST_VARIABLES = """\
  timer{n} : TON;
  run{n}, alarm{n} : BOOL;
  state{n}, count{n} : INT;
  level{n} : REAL;
"""
C_STATION = """\
  ton(&timer{n}, run{n}, 50000000LL, now);
  switch (state{n}) {{
    case 0: if ((int16_t)(tick + {n}) % 7 == 0) {{ run{n} = 1; state{n} = 1; }} break;
    case 1: if (timer{n}.q) {{ run{n} = 0; state{n} = 2; }} break;
    case 2: count{n} = (int16_t)(count{n} + 1); state{n} = 0; break;
  }}
  level{n} = level{n} + 0.125f * ((float)count{n} - level{n});
  if (level{n} > 20.0f || (alarm{n} && level{n} > 10.0f)) alarm{n} = 1; else alarm{n} = 0;
"""
C_VARIABLES = """\
static struct ton timer{n}; static uint8_t run{n}, alarm{n}; static int16_t state{n}, count{n}; static float level{n};
"""
C_PROGRAM = """\
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
struct ton {{ uint8_t in, q; int64_t since, et; }};
static void ton(struct ton *t, uint8_t in, int64_t pt, int64_t now) {{
  if (!in) {{ t->q = 0; t->et = 0; }}
  else {{
    if (!t->in) t->since = now;
    t->et = now - t->since;
    if (t->et >= pt) {{ t->et = pt; t->q = 1; }} else t->q = 0;
  }}
  t->in = in;
}}
static int16_t tick;
{variables}
__attribute__((noinline)) static void scan(int64_t now) {{
  tick = (int16_t)(tick + 1);
{body}}}
int main(int argc, char **argv) {{
  long scans = atol(argv[1]);
  struct timespec a, b;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &a);
  for (long n = 1; n <= scans; n++) scan(n * {cycle}LL);
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &b);
  double sum = 0;
{sum}
  printf("%.9f %.9g\\n", (double)(b.tv_sec - a.tv_sec) + 1e-9 * (double)(b.tv_nsec - a.tv_nsec), sum);
}}
"""


def st_text() -> str:
    stations = range(STATIONS)
    variables = "".join(ST_VARIABLES.format(n=n) for n in stations)
    body = "".join(ST_STATION.format(n=n) for n in stations)
    return f"PROGRAM plant\nVAR\n  tick : INT;\n{variables}END_VAR\n  tick := tick + 1;\n{body}END_PROGRAM\n"


def c_program(folder: Path) -> Path:
    """Compile the C program, and return its path."""
    stations = range(STATIONS)
    text = C_PROGRAM.format(
        variables="".join(C_VARIABLES.format(n=n) for n in stations),
        body="".join(C_STATION.format(n=n) for n in stations),
        sum="".join(f"  sum += (double)level{n} + count{n};\n" for n in stations),
        cycle=CYCLE_NS,
    )
    source, program = folder / "plant.c", folder / "plant"
    source.write_text(text)
    try:
        subprocess.run(["cc", "-O2", "-o", str(program), str(source)], check=True)
    except OSError as e:
        raise Missing("a C compiler (Debian: gcc)") from e
    return program


def c_run(program: Path, scans: int) -> tuple[float, float]:
    """Return the microseconds of CPU time for each scan, and the sum of the results."""
    done = subprocess.run([str(program), str(scans)], capture_output=True, text=True, check=True)
    took_s, total = map(float, done.stdout.split())
    return took_s / scans * 1e6, total


def st_run(text: str, scans: int) -> tuple[float, float]:
    made = program_class(compile_text(text, "plant.st"))()
    infos = [ScanInfo(n * CYCLE_NS, n, n == 1) for n in range(1, scans + 1)]
    began = time.process_time()
    for info in infos:
        made.execute(info)
    took_s = time.process_time() - began
    body = made.st_body
    total = sum(getattr(body, f"v_level{n}") + getattr(body, f"v_count{n}") for n in range(STATIONS))
    return took_s / scans * 1e6, total


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=7)
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args()
    pairs, scans = (2, 300) if given.quick else (given.pairs, 2000)
    text, ours, peers = st_text(), [], []
    with tempfile.TemporaryDirectory() as folder:
        try:
            program = c_program(Path(folder))
        except Missing as e:
            print(f"missing: {e}")
            return 2
        for _ in range(pairs):
            took, total = st_run(text, scans)
            _, expected = c_run(program, scans)
            peer, _ = c_run(program, scans * 100)
            if abs(total - expected) > 1e-6 * abs(expected):
                print(f"the results differ: {total} in place of {expected}")
                return 1
            ours.append(took)
            peers.append(peer)
    print(f"{text.count(chr(10))} lines of Structured Text; microseconds for each scan, and the ratio to C")
    print(row("C, cc -O2", peers, peers))
    print(row("fieldtwin", ours, peers))
    goals = Goals()
    goals.most("a scan, to that in C", sorted(a / b for a, b in zip(ours, peers, strict=True))[len(ours) // 2], GOAL)
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
