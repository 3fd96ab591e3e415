#!/usr/bin/env python3
"""31 units on a serial line at 19200 8N1, 30 of them silent: which share of its polls does the unit that answers keep?

    benchmarks/dead_units.py [--runs 1] [--seconds 150] [--quick] [--peers minimalmodbus,modbus_tk=PYTHON] [--json FILE]

A process models the line and the one unit on a pty, in real time: the characters of request and reply, 5 ms of response time,
silence for all other units. It records the time and unit of each request. Every unit is polled for one register every 500 ms,
with a timeout of 1 s and one repetition: first by our gateway (a separate process), then by pymodbus's async client in a loop
that asks the units in order and starts a round every 500 ms, or at once if the last one took longer. The figure is the share
of the live unit's polls that took place in the worst minute, from the first request on.

The exit status is 1 if the goal is missed, 2 without pymodbus, and 3 if the host was not quiet.
"""

from __future__ import annotations

import argparse
import asyncio
import multiprocessing
import os
import pty
import sys
import tempfile
import time
import tty
from importlib.util import find_spec
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import median

import msgspec
from peers import Goals, python, ratio

from fieldtwin.emulators.wires.serial_line import SerialPacer
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.protocols.modbus.frames.crc import with_crc
from fieldtwin.run.processes.children import Child
from fieldtwin.twin.plant.controller import ControllerConfig
from fieldtwin.twin.plant.mapping import mapping_to_json
from fieldtwin.twin.plant.physical import image_layout, make_image
from fieldtwin.twin.site.system import load_system

UNITS, LIVE, PERIOD_S, WINDOW_S, GOAL = 31, 7, 0.5, 60.0, 0.95
LINE, LATENCY_S = SerialSettings(19200, "8N1"), 0.005
PLANT = "rtu:/dev/ttyBENCH?baudrate=19200&frame=8N1"
REQUEST = 8
REPLY = with_crc(bytes((LIVE, 3, 2, 0, 42)))
PROFILE = """
device: benchmark/level
source: "made for a benchmark: one register"
protocol: modbus
numbering: sent
tags:
  level: {at: "holding:0", poll: level}
"""
PROGRAM = """
from fieldtwin.plc.program import Program

class Idle(Program):
    def execute(self, scan):
        pass
"""
POLLER = Path(__file__).resolve().parents[1] / "scripts/league_programs/dead_line_poller.py"


def line_with_one_unit(fd: int, heard: Connection) -> None:
    """Answer the live unit; send the time and the unit of every request to `heard`."""
    pacer, pending = SerialPacer(LINE), b""
    pause_s = (pacer.duration_ns(REQUEST) + pacer.duration_ns(len(REPLY))) / 1e9 + LATENCY_S
    while True:
        pending += os.read(fd, 256)
        while len(pending) >= REQUEST:
            unit, pending = pending[0], pending[REQUEST:]
            heard.send((time.monotonic(), unit))
            if unit == LIVE:
                time.sleep(pause_s)
                os.write(fd, REPLY)


def system_file(folder: Path) -> Path:
    """The system of 31 devices on a serial line."""
    (folder / "idle_program.py").write_text(PROGRAM)
    (folder / "level.yaml").write_text(PROFILE)
    poll = {"level": {"every_ms": round(PERIOD_S * 1000)}}
    system = {
        "fieldtwin": 1,
        "system": "many",
        "buses": {"line": {"url": PLANT, "timeout_ms": 1000, "retries": 1}},
        "devices": {
            f"d{unit}": {"profile": "level.yaml", "bus": "line", "unit": unit, "poll": poll}
            for unit in range(1, UNITS + 1)
        },
        "plc": {"cycle_ms": 1000, "programs": {"idle": {"source": "python: idle_program:Idle"}}},
    }
    (folder / "many.yaml").write_bytes(msgspec.json.format(msgspec.json.encode(system)))
    return folder / "many.yaml"


async def our_polls(port: str, seconds: float) -> None:
    """Let our gateway poll for this time."""
    with tempfile.TemporaryDirectory(prefix="ft-dead-") as name:
        folder = Path(name)
        path = system_file(folder)
        make_image(image_layout(load_system(str(path))), folder / "image")
        mapping = mapping_to_json({Endpoint.parse(PLANT): Endpoint.parse(PLANT.replace("/dev/ttyBENCH", port))})
        config = folder / "gateway.json"
        config.write_bytes(msgspec.json.encode(ControllerConfig(str(path), str(folder), False, mapping)))
        gateway = Child("gateway", "fieldtwin.twin.plant.controller", config, folder)
        try:
            control = await gateway.connect()
            await asyncio.sleep(seconds)
            failure = gateway.failure()
            assert not failure, failure
            await control.aclose()
        finally:
            await gateway.end(5.0)


async def peer_polls(port: str, seconds: float, library: str, interpreter: str) -> None:
    """Let a third-party library poll for this time."""
    process = await asyncio.create_subprocess_exec(interpreter, str(POLLER), library, port, str(UNITS), str(PERIOD_S))
    try:
        await asyncio.sleep(seconds)
        assert process.returncode is None, process.returncode
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()


def worst_minute(times: list[float], first: float, seconds: float) -> float:
    """Return the lowest share of the due polls in any window of one minute that starts on a tenth of a second."""
    shares = []
    for tenth in range(int((seconds - WINDOW_S) * 10) + 1):
        start = first + tenth / 10
        shares.append(sum(start <= t < start + WINDOW_S for t in times) / (WINDOW_S / PERIOD_S))
    return min(shares)


def measure(name: str, seconds: float, interpreter: str = "") -> tuple[float, float]:
    """Return the share of its polls that the live unit keeps, in its worst minute and in total."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    ours, theirs = multiprocessing.Pipe(duplex=False)
    field = multiprocessing.get_context("fork").Process(target=line_with_one_unit, args=(master, theirs), daemon=True)
    field.start()
    heard: list[tuple[float, int]] = []
    try:

        async def listening() -> None:
            loop = asyncio.get_running_loop()
            loop.add_reader(ours.fileno(), lambda: heard.append(ours.recv()))
            if name == "fieldtwin":
                await our_polls(os.ttyname(slave), seconds + 5.0)
            else:
                await peer_polls(os.ttyname(slave), seconds + 5.0, name, interpreter or python())
            loop.remove_reader(ours.fileno())

        asyncio.run(listening())
    finally:
        field.terminate()
        field.join()
        for fd in (master, slave):
            os.close(fd)
    assert heard, f"{name} sent nothing"
    first = heard[0][0]
    times = [t for t, unit in heard if unit == LIVE and t < first + seconds]
    return worst_minute(times, first, seconds), len(times) / (seconds / PERIOD_S)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=150.0, help="at least 60")
    parser.add_argument("--peers", default="", help="further libraries, each with the Python that has it")
    parser.add_argument("--json", type=Path, help="write the shares to a file")
    parser.add_argument("--quick", action="store_true", help="one run of one minute")
    options = parser.parse_args()
    runs, seconds = (1, WINDOW_S) if options.quick else (options.runs, max(options.seconds, WINDOW_S))
    if find_spec("pymodbus") is None:
        print("pymodbus is not installed: no comparison")
        return 2
    peers = dict(peer.partition("=")[::2] for peer in options.peers.split(",") if peer)
    worst: dict[str, list[float]] = {"fieldtwin": [], "pymodbus": [], **{name: [] for name in peers}}
    whole: dict[str, list[float]] = {name: [] for name in worst}
    for _ in range(runs):
        for name in worst:
            least, all_of_it = measure(name, seconds, peers.get(name, ""))
            worst[name].append(least)
            whole[name].append(all_of_it)
    print(f"polls of the live unit that took place   worst minute   in {seconds:.0f} s   (medians of {runs})")
    for name in worst:
        print(f"  {name:<40} {median(worst[name]):>10.1%} {median(whole[name]):>10.1%}")
    print(f"  {'ratio':<40} {'':>10} {ratio(whole['fieldtwin'], whole['pymodbus']):>10.1f}\n")
    if options.json:
        shares = [{"name": n, "worst_minute": median(worst[n]), "whole": median(whole[n])} for n in worst]
        options.json.write_bytes(msgspec.json.encode(shares))
    goals = Goals()
    goals.least("share of the live unit's polls in the worst minute", median(worst["fieldtwin"]), GOAL)
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
