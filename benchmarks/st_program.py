#!/usr/bin/env python3
"""The cost of a scan of a Structured Text program of 2,600 lines, and of the observatory's program; to the same programs in C.

    benchmarks/st_program.py [--pairs 7] [--quick]

The program has 100 stations with a timer, a CASE over a state, a counter, a filter of REAL and an alarm. The same generator makes
the C program: a structure for each block and plain statements, as a compiler such as matiec writes them; no package has matiec
itself. cc compiles it with -O2. The observatory's program is profiles/systems/relay.st, with the same logic in c/st_relay.c; the
time includes the mailboxes. Both run the same scans; if their results differ, the benchmark fails. The time is the CPU time of
the process, without its start. The program of 2,600 lines is measured as Python code and as machine code (`machine_code: true`);
each is created once, as in a PLC, and runs on in the next round. A scan of the PLC, which also records changes and publishes all
variables, is shown for scale; so is a PROGRAM without a statement, which no program can be faster than.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

from peers import ROOT, Goals, Missing, build, ratio

from fieldtwin.gateway.core.image.image import Message
from fieldtwin.plc.binding import BoundProgram, image_for
from fieldtwin.plc.cycle.scan import Scan
from fieldtwin.plc.program import ScanInfo
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.native.machine import with_machine_code
from fieldtwin.plc.st.program import StProgram, load_source, program_class

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
    subprocess.run(["cc", "-O2", "-o", str(program), str(source)], check=True)
    return program


def c_run(program: Path, scans: int, *arguments: str) -> tuple[float, str]:
    """Return the microseconds of CPU time for each scan, and the results that the C program prints."""
    done = subprocess.run([str(program), str(scans), *arguments], capture_output=True, text=True, check=True)
    took_s, _, results = done.stdout.strip().partition(" ")
    return float(took_s) / scans * 1e6, results


def timed(execute: Callable[[ScanInfo], object], scans: int, before: int = 0) -> float:
    """Return the microseconds of CPU time for each of the calls of `execute`, which come after `before` others."""
    infos = [ScanInfo(n * CYCLE_NS, n, n == 1) for n in range(before + 1, before + scans + 1)]
    began = time.process_time()
    for info in infos:
        execute(info)
    return (time.process_time() - began) / scans * 1e6


class Plant:
    """The generated program, alone and as the program of a PLC."""

    def __init__(self, made: type[StProgram], c: Path) -> None:
        self._made, self.c = made, c
        self._running, self._scans = made(), 0

    def c_us(self, scans: int) -> float:
        return c_run(self.c, scans * 100)[0]

    def logic_us(self, scans: int) -> float:
        """Return the time of the program alone, with its tags.

        Raises `Different` if its results are not those of the C program.
        """
        took = timed(self._running.execute, scans, self._scans)
        self._scans += scans
        body = self._running.st_body
        total = sum(getattr(body, f"v_level{n}") + getattr(body, f"v_count{n}") for n in range(STATIONS))
        expected = float(c_run(self.c, self._scans)[1])
        if abs(total - expected) > 1e-6 * abs(expected):
            raise Different(f"{total} in place of {expected}")
        return took

    def scan_us(self, scans: int) -> float:
        """Return the time of a scan of the PLC: it also records changes for `plc why` and publishes all variables."""
        bound = BoundProgram("plant", self._made(), {})
        layout = image_for([bound], {})
        memory = memoryview(bytearray(layout.size))
        layout.format(memory)
        scan = Scan(layout.attach(memory), [bound], 1e12)
        return timed(lambda info: scan.execute(info.now_ns), scans)


class Empty:
    """A PROGRAM without a statement."""

    def __init__(self, made: type[StProgram]) -> None:
        self._made = made

    def logic_us(self, scans: int) -> float:
        return timed(self._made().execute, scans)


class Relay:
    """The observatory's program in Structured Text, with one response of the sensor in each `every`th scan."""

    def __init__(self, made: type[StProgram], c: Path, every: int) -> None:
        self._made, self._c, self._every = made, c, every

    def c_us(self, scans: int) -> float:
        return c_run(self._c, scans * 100, str(self._every))[0]

    def logic_us(self, scans: int) -> float:
        """Return the time of the program alone. Raises `Different` if its results are not those of the C program."""
        made = self._made()
        space, last = made.__dict__, b""
        response, log = space["response"], space["log"]

        def execute(info: ScanInfo) -> None:
            nonlocal last
            n = info.number
            space["command"] = (Message(1, 0, b"\0\1"),) if n == 1 else ()
            space["sample"] = (Message(n, 0, b"0123456789abcdef"),) if self._every and n % self._every == 0 else ()
            made.execute(info)
            if log.pending:
                last = log.pending[-1][1]
            response.pending, log.pending = [], []

        took = timed(execute, scans)
        results = f"{space['logged']} {space['dropped']} {last.decode()}"
        expected = c_run(self._c, scans, str(self._every))[1]
        if results != expected:
            raise Different(f"{results} in place of {expected}")
        return took


class Different(Exception):
    """The results of a program differ from those of the C program."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=7)
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args()
    pairs, scans = (2, 300) if given.quick else (given.pairs, 2000)
    text = st_text()
    with tempfile.TemporaryDirectory() as folder:
        try:
            relay_c = build("st_relay")
            plant = Plant(program_class(compile_text(text, "plant.st")), c_program(Path(folder)))
        except Missing as e:
            print(f"missing: {e}")
            return 2
        relay = load_source(ROOT / "profiles" / "systems" / "relay.st")
        idle, busy = Relay(relay, relay_c, 0), Relay(relay, relay_c, 10)
        lines = f"{text.count(chr(10)):,} lines"
        fast = Plant(program_class(with_machine_code(compile_text(text, "plant.st"))), plant.c)
        empty = Empty(program_class(compile_text("PROGRAM nothing END_PROGRAM", "nothing.st")))
        cases: dict[str, tuple[Callable[[int], float], Callable[[int], float]]] = {
            f"{lines}: the logic": (plant.c_us, plant.logic_us),
            f"{lines}: the logic, machine code": (plant.c_us, fast.logic_us),
            f"{lines}: scan of the PLC": (plant.c_us, plant.scan_us),
            f"{lines}: scan, machine code": (plant.c_us, fast.scan_us),
            "no statement, to the observatory": (idle.c_us, empty.logic_us),
            "observatory, no message": (idle.c_us, idle.logic_us),
            "observatory, 10 responses/s": (busy.c_us, busy.logic_us),
        }
        ours: dict[str, list[float]] = {name: [] for name in cases}
        peers: dict[str, list[float]] = {name: [] for name in cases}
        for _ in range(pairs):
            for name, (c_us, st_us) in cases.items():
                try:
                    ours[name].append(st_us(scans))
                except Different as e:
                    print(f"{name}: the results differ: {e}")
                    return 1
                peers[name].append(c_us(scans))
    print(f"{'microseconds for each scan':<36} {'C, cc -O2':>10} {'fieldtwin':>10} {'ratio':>8}")
    goals = Goals()
    for name in cases:
        times = ratio(ours[name], peers[name])
        print(f"{name:<36} {median(peers[name]):>10.3f} {median(ours[name]):>10.1f} {times:>8.0f}")
        if name.startswith("observatory") or name.endswith("the logic, machine code"):
            goals.most(f"{name}, to that in C", times, GOAL)
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
