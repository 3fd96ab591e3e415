#!/usr/bin/env python3
"""Emulator over TCP against libmodbus's and pymodbus's servers, one libmodbus C client reading 10 registers.

    benchmarks/emulator_tcp.py [--runs 5] [--seconds 2]

Interleaved runs, ratios pairwise to libmodbus's own C server. Needs gcc and libmodbus-dev.
"""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
from statistics import median

from peers import HERE, Missing, build, cpu_s, free_port, python, row, start, stop


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0)
    options = parser.parse_args()
    try:
        client, server = build("modbus_client"), build("modbus_server")
    except Missing as e:
        print(f"emulator_tcp: needs {e}", file=sys.stderr)
        return 2
    servers = {
        "libmodbus": [str(server)],
        "fieldtwin": [python(), str(HERE / "serve_emulator.py")],
        "pymodbus": [python(), str(HERE / "serve_pymodbus.py")],
    }
    if importlib.util.find_spec("uvloop"):
        servers["fieldtwin (uvloop)"] = [python(), str(HERE / "serve_emulator.py"), "--uvloop"]
    rate: dict[str, list[float]] = {name: [] for name in servers}
    cpu: dict[str, list[float]] = {name: [] for name in servers}
    for _ in range(options.runs):
        for name, command in servers.items():
            port = free_port()
            process = start(
                [command[0], *command[1:2], str(port), *command[2:]] if len(command) > 1 else [*command, str(port)]
            )
            try:
                before = cpu_s(process.pid)
                said = subprocess.run(
                    [str(client), "127.0.0.1", str(port), str(options.seconds)],
                    capture_output=True,
                    text=True,
                    check=True,
                ).stdout.split()
                rate[name].append(float(said[0]))
                cpu[name].append((cpu_s(process.pid) - before) / (float(said[0]) * options.seconds) * 1e6)
            finally:
                stop(process)
    print(f"{'requests/s':<22} {'median':>12}   ratio")
    for name in servers:
        print(row(name, rate[name], rate["libmodbus"]))
    print(f"\n{'server CPU, us/request':<22} {'median':>12}   ratio")
    for name in servers:
        print(row(name, cpu[name], cpu["libmodbus"]))
    against = median(a / b for a, b in zip(rate["fieldtwin"], rate["pymodbus"], strict=True))
    print(f"\nfieldtwin / pymodbus requests: {against:.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
