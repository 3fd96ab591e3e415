"""Helpers for the benchmarks: build the C peers, start servers, and measure the CPU time of a process.

Benchmarks compare with a named peer in the same run and print ratios with medians; single absolute figures on a shared machine
have little meaning. The tests do not use this module.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from host import AT_START, HostChange, HostState

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))  # started from a checkout that is not installed


class Missing(Exception):
    """A missing peer; the message names the package to install."""


def build(name: str, *libraries: str) -> Path:
    """Compile benchmarks/c/NAME.c, linked with `libraries`, and return the program's path."""
    if shutil.which("cc") is None:
        raise Missing("a C compiler (Debian: gcc)")
    out = Path(tempfile.mkdtemp(prefix="fieldtwin-bench-")) / name
    source = HERE / "c" / f"{name}.c"
    done = subprocess.run(
        ["cc", "-O2", "-o", str(out), str(source), *(f"-l{library}" for library in libraries)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        needed = " ".join(f"lib{library}-dev" for library in libraries)
        raise Missing(f"a C library (Debian: {needed}): {done.stderr.strip().splitlines()[0]}")
    return out


def start(command: list[str]) -> subprocess.Popen[str]:
    """Start a server that prints `ready` when it listens."""
    environment = {**os.environ, "PYTHONPATH": str(HERE.parent)}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None
    line = process.stdout.readline().strip()
    if line != "ready":
        process.kill()
        raise Missing(f"{command[0]} did not get ready: {line!r}")
    return process


def stop(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.wait()
    if process.stdout is not None:
        process.stdout.close()


def cpu_s(pid: int) -> float:
    """Return the user and system time that a process has used, in seconds."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def rss_mb(pid: int) -> float:
    """Return the present memory of a process, in MB (10^6 bytes), including shared pages."""
    return _status_kib(pid, "VmRSS") * 1024 / 1e6


def peak_mb(pid: int) -> float:
    """Return its maximum memory."""
    return _status_kib(pid, "VmHWM") * 1024 / 1e6


def _status_kib(pid: int, key: str) -> int:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{key}:"))


def free_port() -> int:
    import socket

    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port: int = s.getsockname()[1]
        return port


def ratio(values: list[float], base: list[float]) -> float:
    """Return the median of the pairwise ratios: each pair was measured one after the other."""
    return median(v / b for v, b in zip(values, base, strict=True))


def row(name: str, values: list[float], base: list[float]) -> str:
    """Print one line of a table: median, and the median of the pairwise ratios to `base`."""
    return f"{name:<24} {median(values):>12.1f}   {ratio(values, base):>6.2f}"


class Goals:
    """The goals of a benchmark, judged and printed at its end.

    The goals of a timing are inconclusive if the host was not quiet since the benchmark began (`host.py` has the limits).
    `timed=False` is for results that do not depend on time.
    """

    def __init__(self, *, timed: bool = True) -> None:
        self._timed = timed
        self._results: list[tuple[bool, str]] = []

    def least(self, what: str, got: float, goal: float, unit: str = "") -> None:
        self._add(what, got, f"at least {goal:g}", got >= goal, unit)

    def most(self, what: str, got: float, goal: float, unit: str = "") -> None:
        self._add(what, got, f"at most {goal:g}", got <= goal, unit)

    def _add(self, what: str, got: float, goal: str, reached: bool, unit: str) -> None:
        shown = f"{got:.3g}" if abs(got) < 1000 else f"{got:.0f}"
        self._results.append((reached, f"{what}: {shown} (goal: {goal}{' ' + unit if unit else ''})"))

    def verdict(self, before: HostState = AT_START, after: HostState | None = None) -> int:
        """Print the goals and the state of the host. Return the exit status: 0 all reached, 1 one missed, 3 inconclusive."""
        change = HostChange(before, after or HostState.read())
        reason = change.disturbance() if self._timed else ""
        for reached, text in self._results:
            print(f"{'INCONCLUSIVE' if reason else 'reached' if reached else 'MISSED':<8} {text}")
        if self._timed:
            print(change)
        if reason:
            print(f"INCONCLUSIVE: {reason}; repeat the benchmark on a quiet host")
            return 3
        return 0 if all(reached for reached, _ in self._results) else 1


def python() -> str:
    return sys.executable
