#!/usr/bin/env python3
"""The lateness of a scan's start, against cyclictest (Debian's rt-tests), with a gateway that is busy on three buses as load.

    benchmarks/plc_jitter.py [--runs 3] [--seconds 10] [--quick]

The load is the observatory's prototype: simulated field devices, gateway on a serial line, CANopen and Modbus TCP, and its own
PLC. Then in turn: cyclictest with one thread, our PLC process, and our PLC process while a third process reads its image as
fast as possible; each in the same scheduling class (SCHED_FIFO 10 if this host allows it), at 10 ms and at 1 ms. Ratios and
differences are those of pairs. The exit status is 1 if a goal is missed, 2 if cyclictest is missing.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from peers import Goals, python

from fieldtwin.gateway.core.image.image import TagKind, TagSpec
from fieldtwin.plc.binding import InputBinding, image_for
from fieldtwin.plc.runtime.config import PlcConfig, ProgramConfig
from fieldtwin.twin.plant.physical import make_image

ROOT = Path(__file__).resolve().parents[1]
PRIORITY = 10
PROGRAM = """
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, var_input, var_output

class Copy(Program):
    x = var_input(TagKind.REAL)
    y = var_output(TagKind.REAL, initial=0.0)

    def execute(self, scan):
        self.y = (self.x or 0.0) + 1.0
"""


@dataclass
class Lateness:
    """The figures of one run: us, and the share of scans that began more than 1 ms late."""

    p50: float
    p99: float
    above_1ms: float


def cyclictest(cycle_ms: int, seconds: float, fifo: bool) -> Lateness:
    command = [
        "cyclictest",
        "-q",
        "-t",
        "1",
        "-i",
        str(cycle_ms * 1000),
        "-D",
        str(max(1, round(seconds))),
        "-h",
        "20000",
    ]
    command += ["-m", "-p", str(PRIORITY)] if fifo else ["--policy=other"]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    counts: list[tuple[int, int]] = []
    for line in said.splitlines():
        fields = line.split()
        if len(fields) == 2 and not line.startswith("#"):
            counts.append((int(fields[0]), int(fields[1])))
    over = next(
        (int(f) for line in said.splitlines() if line.startswith("# Histogram Overflows:") for f in [line.split()[-1]]),
        0,
    )
    total = sum(n for _, n in counts) + over

    def percentile(share: float) -> float:
        seen = 0
        for us, n in counts:
            seen += n
            if n and seen >= total * share:
                return float(us)
        return 20_000.0

    late = sum(n for us, n in counts if us > 1000) + over
    return Lateness(percentile(0.5), percentile(0.99), late / total)


def asked(path: Path) -> dict[str, Any]:
    with socket.socket(socket.AF_UNIX) as s:
        s.connect(str(path))
        s.sendall(b'{"v": 1, "id": 1, "command": "get", "args": {}}\n')
        with s.makefile("rb") as lines:
            found: dict[str, Any] = json.loads(lines.readline())["result"]
    return found


@contextmanager
def reader(image: Path, layout: dict[str, Any]) -> Iterator[None]:
    """A process that takes snapshots of both regions as fast as possible."""
    code = (
        "import json, mmap, sys\nfrom fieldtwin.gateway.core.image.image import ImageLayout\n"
        "layout = ImageLayout.from_description(json.loads(sys.argv[2]))\n"
        "file = open(sys.argv[1], 'r+b')\nmapped = mmap.mmap(file.fileno(), 0)\n"
        "image = layout.attach(memoryview(mapped))\nreaders = [image.reader(r.name) for r in layout.regions]\n"
        "while True:\n    for reader in readers: reader.snapshot()\n"
    )
    process = subprocess.Popen(
        [python(), "-c", code, str(image), json.dumps(layout)], env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    try:
        yield
    finally:
        process.kill()
        process.wait()


def our_plc(cycle_ms: int, seconds: float, fifo: bool, read: bool) -> Lateness:
    with tempfile.TemporaryDirectory(prefix="ft-jitter-") as name:
        folder = Path(name)
        (folder / "copy_program.py").write_text(PROGRAM)
        program = ProgramConfig("copy", "python: copy_program:Copy", {"x": InputBinding("d.x")})
        layout = image_for([program.bind((name,))], {"d.x": TagSpec("d.x", TagKind.REAL)})
        make_image(layout, folder / "image")
        config = PlcConfig(
            str(folder / "image"), layout.describe(), str(folder / "plc.sock"), (program,), cycle_ms=cycle_ms,
            late_ms=1000.0, stop_after=0, priority=PRIORITY if fifo else 0, python_path=(name,),
        )  # fmt: skip
        (folder / "plc.json").write_bytes(config.to_json())
        process = subprocess.Popen(
            [python(), "-m", "plc", str(folder / "plc.json")], env={**os.environ, "PYTHONPATH": str(ROOT)}
        )
        try:
            while not (folder / "plc.sock").exists():
                time.sleep(0.05)
            if read:
                with reader(folder / "image", layout.describe()):
                    time.sleep(seconds)
                    late = asked(folder / "plc.sock")["lateness_us"]
            else:
                time.sleep(seconds)
                late = asked(folder / "plc.sock")["lateness_us"]
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait()
    return Lateness(late["p50"], late["p99"], late["above_1ms"])


@contextmanager
def busy_gateway() -> Iterator[None]:
    with tempfile.TemporaryDirectory(prefix="ft-load-") as run:
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "FIELDTWIN_RUN": run}
        command = [python(), "-m", "fieldtwin", "run", "observatory", "--prototype", "--commands", "1", "--json"]
        process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            time.sleep(5)
            if process.poll() is not None:
                raise SystemExit("the load did not start")
            yield
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait()


def fifo_allowed() -> bool:
    probe = f"import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({PRIORITY}))"
    return subprocess.run([python(), "-c", probe], capture_output=True, check=False).returncode == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    if shutil.which("cyclictest") is None:
        print("plc_jitter: needs cyclictest (Debian: rt-tests)", file=sys.stderr)
        return 2
    runs, seconds = (1, 4.0) if options.quick else (options.runs, options.seconds)
    fifo, goals = fifo_allowed(), Goals()
    print(f"scheduling class: {'SCHED_FIFO' if fifo else 'SCHED_OTHER'}, {os.cpu_count()} processors\n")
    with busy_gateway():
        for cycle_ms in (10, 1):
            anchor, ours, watched = [], [], []
            for _ in range(runs):
                anchor.append(cyclictest(cycle_ms, seconds, fifo))
                ours.append(our_plc(cycle_ms, seconds, fifo, read=False))
                watched.append(our_plc(cycle_ms, seconds, fifo, read=True))
            print(f"{cycle_ms} ms cycle                  p50 us   p99 us   later than 1 ms")
            for name, rows in (("cyclictest", anchor), ("fieldtwin plc", ours), ("image being read", watched)):
                share = median(r.above_1ms for r in rows)
                print(
                    f"  {name:<24} {median(r.p50 for r in rows):>6.0f}   {median(r.p99 for r in rows):>6.0f}   {share:.3%}"
                )
            pairs = list(zip(anchor, ours, strict=True))
            more = list(zip(ours, watched, strict=True))
            goals.most(f"{cycle_ms} ms: p50 above cyclictest's", median(o.p50 - a.p50 for a, o in pairs), 60, "us")
            goals.most(f"{cycle_ms} ms: p99 / cyclictest's", median(o.p99 / a.p99 for a, o in pairs), 3)
            goals.most(
                f"{cycle_ms} ms: share later than 1 ms, above cyclictest's",
                median(o.above_1ms - a.above_1ms for a, o in pairs),
                0.01,
            )
            goals.most(f"{cycle_ms} ms: p50 with a reader, more", median(w.p50 - o.p50 for o, w in more), 20, "us")
            goals.most(f"{cycle_ms} ms: p99 with a reader, more", median(w.p99 - o.p99 for o, w in more), 20, "us")
            print()
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
