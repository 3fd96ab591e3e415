#!/usr/bin/env python3
"""A scan of 247 units at 9600 baud 8N1, modelled on a pty: how close is its real time to the minimum given by its timeout?

    benchmarks/scan.py [--runs 3] [--timeout-ms 50] [--quick]

Three units of a line modelled by an emulator (a separate process) answer after 5 ms, the others are silent. In theory a silent
unit costs 8 characters and the timeout, and one that answers 8 characters, 5 ms, 7 characters and 3.5 of silence. The peer is
minimalmodbus in a loop over the same units with the same timeout, which counts from the write and thus includes the characters
of the request. Runs alternate; the results are medians. The exit status is 1 if the goal is missed.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from peers import Goals, python, ratio

from fieldtwin.commissioning.scan.modbus import ModbusScanner, ScanOptions
from fieldtwin.emulators.wires.serial_line import SerialPacer
from fieldtwin.gateway.core.endpoint import SerialSettings
from fieldtwin.gateway.wallclock import run as run_precise

LINE, LATENCY_S, PRESENT, GOAL = SerialSettings(9600, "8N1"), 0.005, (3, 100, 247), 1.1
DEVICE = f"""
import asyncio, sys
from pathlib import Path
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.modbus.bank import MapBank, CellSpan
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.endpoints.modbus_server import serve_rtu
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.wallclock import WallClock, run

async def main():
    end = await PtyEnd.open(Path(sys.argv[1]), Endpoint.parse("pty:x"), SerialSettings(9600, "8N1"))
    server = RtuServer({{n: ModbusUnit(MapBank([CellSpan("holding", 0, 10)])) for n in {PRESENT}}})
    print("ready", flush=True)
    await serve_rtu(end, server, WallClock(), {LATENCY_S})

run(main())
"""
CLIENT = """
import sys, time, minimalmodbus, serial
path, timeout_s, units = sys.argv[1], float(sys.argv[2]), int(sys.argv[3])
device = minimalmodbus.Instrument(path, 1)
device.serial.baudrate, device.serial.timeout = 9600, timeout_s
found, began = [], time.perf_counter()
for unit in range(1, units + 1):
    device.address = unit
    try:
        device.read_register(0)
        found.append(unit)
    except minimalmodbus.NoResponseError:
        pass
print(time.perf_counter() - began, *found)
"""


def theory_s(units: int, timeout_s: float) -> float:
    """Return the seconds given by the line and the timeout."""
    line, there = SerialPacer(LINE), [u for u in PRESENT if u <= units]
    answered_s = (line.duration_ns(15) + line.t3_5_ns) / 1e9 + LATENCY_S
    return (units - len(there)) * (line.duration_ns(8) / 1e9 + timeout_s) + len(there) * answered_s


def ours(port: Path, timeout_s: float, units: int) -> float:
    options = ScanOptions(units=tuple(range(1, units + 1)), timeout_s=timeout_s, per_s=1000, listen_s=0)
    began = time.perf_counter()
    found = run_precise(ModbusScanner(f"rtu:{port}?baudrate=9600&frame=8N1", options).run())
    assert [f.answer.unit for f in found.units] == [u for u in PRESENT if u <= units], found.units
    return time.perf_counter() - began


def peers(port: Path, timeout_s: float, units: int) -> float:
    words = [python(), "-c", CLIENT, str(port), str(timeout_s), str(units)]
    told = subprocess.run(words, check=True, capture_output=True, text=True).stdout.split()
    assert [int(u) for u in told[1:]] == [u for u in PRESENT if u <= units], told
    return float(told[0])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--timeout-ms", type=float, default=50)
    parser.add_argument("--quick", action="store_true", help="one run of 60 units")
    options = parser.parse_args()
    runs, units = (1, 60) if options.quick else (options.runs, 247)
    timeout_s = options.timeout_ms / 1000
    mine: list[float] = []
    theirs: list[float] = []
    with tempfile.TemporaryDirectory(prefix="ft-scan-") as name:
        port = Path(name) / "line"
        device = subprocess.Popen([python(), "-c", DEVICE, str(port)], stdout=subprocess.PIPE, text=True)
        try:
            assert device.stdout is not None
            assert device.stdout.readline().strip() == "ready"
            for _ in range(runs):
                mine.append(ours(port, timeout_s, units))
                theirs.append(peers(port, timeout_s, units))
        finally:
            device.kill()
            device.wait()
            device.stdout.close()  # type: ignore[union-attr]
    theory = theory_s(units, timeout_s)
    print(f"{units} units, timeout {timeout_s * 1000:g} ms (theory {theory:.2f} s)   median   of theory")
    for what, taken in (("fieldtwin scan", mine), ("minimalmodbus", theirs)):
        print(f"  {what:<22} {median(taken):>6.2f} s   {median(taken) / theory:>6.3f}")
    print(f"  ratio                  {ratio(mine, theirs):>6.2f}\n")
    goals = Goals()
    goals.most("time of the scan, of what theory allows", median(mine) / theory, GOAL)
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
