#!/usr/bin/env python3
"""The emulator over TCP against libmodbus's and pymodbus's servers: 10 registers per request.

    benchmarks/emulator_tcp.py [--runs 5] [--seconds 2] [--clients 64] [--quick]

One libmodbus C client, then many clients at once. Runs of all servers are interleaved; the results are medians and ratios of
pairs. The exit status is 1 if a goal is missed. Needs gcc and libmodbus-dev, uvloop (the `perf` extra) for its rows, and an
idle machine.
"""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
from pathlib import Path

from peers import HERE, Goals, Missing, build, cpu_s, free_port, python, ratio, row, start, stop

PLAIN, FAST = "fieldtwin", "fieldtwin (uvloop)"


class Server:
    """A server under measurement: its command, and its results."""

    def __init__(self, name: str, *command: str, flags: tuple[str, ...] = ()) -> None:
        self.name = name
        self.command, self.flags = command, flags
        self.rate: list[float] = []
        self.cpu_us: list[float] = []

    def measure(self, client: list[str], seconds: float) -> None:
        port = free_port()
        process = start([*self.command, str(port), *self.flags])
        try:
            before = cpu_s(process.pid)
            command = [client[0], "127.0.0.1", str(port), str(seconds), *client[1:]]
            said = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
            self.rate.append(float(said[0]))
            self.cpu_us.append((cpu_s(process.pid) - before) / (float(said[0]) * seconds) * 1e6)
        finally:
            stop(process)


def servers(libmodbus: Path | None) -> list[Server]:
    emulator = (python(), str(HERE / "serve_emulator.py"))
    found = [Server("libmodbus", str(libmodbus))] if libmodbus else []
    found += [Server(PLAIN, *emulator), Server("pymodbus", python(), str(HERE / "serve_pymodbus.py"))]
    if importlib.util.find_spec("uvloop"):
        found.append(Server(FAST, *emulator, flags=("--uvloop",)))
    return found


def compare(found: list[Server], client: list[str], runs: int, seconds: float) -> dict[str, Server]:
    """Measure all in turn, `runs` times; print medians and ratios to the first."""
    for _ in range(runs):
        for server in found:
            server.measure(client, seconds)
    for what, key in (("requests/s", "rate"), ("server CPU, us/request", "cpu_us")):
        print(f"{what:<24} {'median':>12}   ratio to {found[0].name}")
        for server in found:
            print(row(server.name, getattr(server, key), getattr(found[0], key)))
        print()
    return {server.name: server for server in found}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--clients", type=int, default=64)
    parser.add_argument("--quick", action="store_true", help="one run of 1 s")
    options = parser.parse_args()
    runs, seconds = (1, 1.0) if options.quick else (options.runs, options.seconds)
    try:
        one, many, libmodbus = (build(f"modbus_{name}", "modbus") for name in ("client", "clients", "server"))
    except Missing as e:
        print(f"emulator_tcp: needs {e}", file=sys.stderr)
        return 2
    goals = Goals()
    print("one client (libmodbus, C)\n")
    single = compare(servers(libmodbus), [str(one)], runs, seconds)
    for name, rate, cpu in ((PLAIN, 0.80, 2.2), (FAST, 0.85, 1.6)):
        if name in single:
            goals.least(f"{name} / libmodbus, requests/s", ratio(single[name].rate, single["libmodbus"].rate), rate)
            goals.most(f"{name} / libmodbus, CPU", ratio(single[name].cpu_us, single["libmodbus"].cpu_us), cpu)
    best = FAST if FAST in single else PLAIN
    goals.least(f"{best} / pymodbus, requests/s", ratio(single[best].rate, single["pymodbus"].rate), 1.6)

    print(f"{options.clients} clients at once (one C thread)\n")
    crowd = compare(servers(None), [str(many), str(options.clients)], runs, seconds)
    goals.least(f"{best} / pymodbus, {options.clients} clients", ratio(crowd[best].rate, crowd["pymodbus"].rate), 2.5)
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
