#!/usr/bin/env python3
"""1,000 emulated Modbus TCP devices in one process, each on a separate port and polled once a second by one gateway.

    benchmarks/modbus_fleet.py [--devices 1000] [--seconds 30] [--runs 5] [--quick]

The benchmark creates a system, a profile of 20 registers (a poll is one request, so that devices can count polls), a recording
and a prototype file. Goals: all devices listen 5 s after the start of their process, the process never uses more than 200 MB,
and in `--seconds` no device misses a poll, counted by the devices, not by the gateway. The gateway is the one of `fieldtwin
run`, in a separate process. The peer is pymodbus: the same number of its servers in one process, for start-up time and memory,
`--runs` times alternating with ours, with ratios of pairs. The polling is one run. The exit status is 1 if a goal is missed. A
start within 5 s needs an idle machine.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import msgspec
from peers import HERE, Goals, cpu_s, peak_mb, python, ratio, rss_mb, start, stop

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.run.processes.children import Child
from fieldtwin.twin.plant.controller import ControllerConfig
from fieldtwin.twin.plant.mapping import mapped_endpoint, mapping_to_json
from fieldtwin.twin.plant.physical import image_layout, make_image
from fieldtwin.twin.prototype.field_process import FieldConfig
from fieldtwin.twin.site.system import System, load_system

PROFILE, RECORDING, UNIT, REGISTERS, RECORDED = "meter.yaml", "meter.jsonl", 1, 20, 100
METER = f"""
device: benchmark/meter
source: "made for a benchmark: 20 registers"
protocol: modbus
factory: {{unit: {UNIT}}}
numbering: sent
defaults: {{type: uint16, poll: values}}
tags:
  value_1..{REGISTERS}: {{at: "holding:0"}}
"""
UP_S, MOST_MB, PERIOD_S = 5.0, 200.0, 1.0
SETTLE_S = 60.0
"""Time limit until all devices are online for the first time, on a loaded machine."""
SETTLED = 4
"""Polls that each device must have answered before counting begins."""
RECOVER_S = 3.0
"""A gateway that reports all details of 24,000 tags cannot poll meanwhile, so it is asked only before and after the window."""
HALF_PERIOD_S = PERIOD_S / 2
"""Surplus of the window over whole periods: a poll with a smaller delay is still inside the window."""
PROGRAM = '''
from fieldtwin.plc.program import Program

class Idle(Program):
    """A gateway has a PLC; this one commands nothing."""

    def execute(self, scan):
        pass
'''


def make_files(folder: Path, devices: int) -> Path:
    """Write the system file of this number of devices, each on a separate host, with its prototype file."""
    (folder / "idle_program.py").write_text(PROGRAM)
    (folder / PROFILE).write_text(METER)
    lines: list[dict[str, Any]] = [
        {"fieldtwin_recording": 1, "device": "benchmark/meter", "kind": "exchanges", "source": "synthetic"}
    ]
    for n in range(RECORDED):
        words = b"".join((n * 257 + i).to_bytes(2, "big") for i in range(REGISTERS))
        reply = bytes((3, len(words))) + words
        lines.append({"t": float(n), "unit": UNIT, "req": f"030000{REGISTERS:04x}", "rep": reply.hex(), "lat": 0.01})
    (folder / RECORDING).write_text("".join(json.dumps(line) + "\n" for line in lines))
    buses = {f"b{i}": {"url": f"tcp://192.0.2.1:{10_000 + i}"} for i in range(devices)}
    poll = {"values": {"every_ms": round(PERIOD_S * 1000)}}
    on_them = {f"d{i}": {"profile": PROFILE, "bus": f"b{i}", "unit": UNIT, "poll": poll} for i in range(devices)}
    plc = {"cycle_ms": 1000, "programs": {"idle": {"source": "python: idle_program:Idle"}}}
    system = {"fieldtwin": 1, "system": "fleet", "buses": buses, "devices": on_them, "plc": plc}
    prototype = {
        "prototype_of": "fleet.yaml",
        "buses": {bus: {"listen": "tcp://127.0.0.1:0"} for bus in buses},
        "devices": {device: {"recording": RECORDING, "at_end": "loop"} for device in on_them},
    }
    for name, content in (("fleet.yaml", system), ("fleet.prototype.yaml", prototype)):
        (folder / name).write_bytes(msgspec.json.format(msgspec.json.encode(content)))
    return folder / "fleet.yaml"


@dataclass
class Up:
    """Measure a process with all its servers: seconds until they listened, and its memory then."""

    seconds: float
    mb: float


async def emulators_up(folder: Path, system: Path) -> tuple[Child, ControlClient, Up]:
    config = folder / "field.json"
    config.write_bytes(msgspec.json.encode(FieldConfig(str(system), str(folder))))
    began = time.perf_counter()
    child = Child("field", "fieldtwin.twin.prototype.field_process", config, folder)
    client = await child.connect()
    return child, client, Up(time.perf_counter() - began, rss_mb(child.pid))


def pymodbus_up(devices: int) -> Up:
    began = time.perf_counter()
    process = start([python(), str(HERE / "serve_pymodbus.py"), "0", str(devices)])
    try:
        return Up(time.perf_counter() - began, rss_mb(process.pid))
    finally:
        stop(process)


async def compare_up(devices: int, runs: int, goals: Goals) -> None:
    ours, theirs = [], []
    for _ in range(runs):
        with tempfile.TemporaryDirectory(prefix="ft-fleet-") as name:
            child, client, up = await emulators_up(Path(name), make_files(Path(name), devices))
            ours.append(up)
            await client.aclose()
            await child.end()
        theirs.append(pymodbus_up(devices))
    print(f"{devices} servers in a process      up, s   memory then, MB     (medians of {runs})")
    for name, rows in (("fieldtwin, devices", ours), ("pymodbus, registers", theirs)):
        print(f"  {name:<24} {median(r.seconds for r in rows):>6.2f}   {median(r.mb for r in rows):>6.0f}")
    slower, more = (ratio([getattr(r, k) for r in ours], [getattr(r, k) for r in theirs]) for k in ("seconds", "mb"))
    print(f"  ratio                    {slower:>6.2f}   {more:>6.2f}\n")
    goals.most(f"{devices} devices up", median(r.seconds for r in ours), UP_S, "s")


def requests(status: dict[str, Any]) -> dict[str, int]:
    """Return the answered requests of each device, as the device counts them."""
    return {name: d["counters"]["replies"] for name, d in status["devices"].items()}


def polls_of(status: dict[str, Any]) -> tuple[int, int]:
    """Return polls and failed polls of all devices, as the gateway counts them."""
    return sum(d["polls"] for d in status["devices"].values()), sum(d["errors"] for d in status["devices"].values())


async def poll(devices: int, seconds: float, goals: Goals) -> None:
    with tempfile.TemporaryDirectory(prefix="ft-fleet-") as name:
        folder = Path(name)
        path = make_files(folder, devices)
        field, field_client, _ = await emulators_up(folder, path)
        try:
            system = load_system(str(path))
            make_image(image_layout(system), folder / "image")
            listening = (await field_client.call("get", timeout_s=30))["listening"]
            mapping = {
                bus.endpoint: mapped_endpoint(bus.endpoint, Endpoint.parse(listening[bus.name]))
                for bus in system.buses.values()
            }
            config = ControllerConfig(str(path), str(folder), False, mapping_to_json(mapping))
            (folder / "gateway.json").write_bytes(msgspec.json.encode(config))
            gateway = Child("gateway", "fieldtwin.twin.plant.controller", folder / "gateway.json", folder)
            try:
                await watch(field, field_client, gateway, system, seconds, goals)
            finally:
                await gateway.end(5.0)
        finally:
            await field_client.aclose()
            await field.end()


async def watch(
    field: Child, client: ControlClient, gateway: Child, system: System, seconds: float, goals: Goals
) -> None:
    """Wait until every device is polled, then count for `seconds`."""
    control, devices = await gateway.connect(), len(system.devices)
    began = time.perf_counter()
    counted: dict[str, int] = {}
    while len(counted) < devices or min(counted.values()) < SETTLED:  # online, identified, polled
        if time.perf_counter() - began > SETTLE_S or gateway.failure():
            raise SystemExit(f"modbus_fleet: not every device was polled within {SETTLE_S} s: {gateway.failure()}")
        await asyncio.sleep(0.5)
        counted = requests(await client.call("get", timeout_s=30))
    print(f"every device is polled {time.perf_counter() - began:.1f} s after the gateway was ready")
    polled = polls_of(await control.call("get", timeout_s=30))
    await asyncio.sleep(RECOVER_S)
    before, cpu_before, t0 = requests(await client.call("get", timeout_s=30)), cpu(field, gateway), time.perf_counter()
    await asyncio.sleep(seconds + HALF_PERIOD_S)
    after, cpu_after = requests(await client.call("get", timeout_s=30)), cpu(field, gateway)
    took_s = time.perf_counter() - t0
    told = [b - a for a, b in zip(polled, polls_of(await control.call("get", timeout_s=30)), strict=True)]
    got = {name: after[name] - before[name] for name in before}
    due = int((took_s - HALF_PERIOD_S) / PERIOD_S)
    short = sum(due - n for n in got.values() if n < due)
    field_cpu, gateway_cpu = ((b - a) / took_s for a, b in zip(cpu_before, cpu_after, strict=True))
    polls = sum(got.values())
    print(f"{polls:.0f} polls in {took_s:.1f} s; a device got {min(got.values()):g} to {max(got.values()):g}")
    print("                         CPU      us/poll   memory, MB (most)")
    for name, share, child in (("emulators", field_cpu, field), ("gateway", gateway_cpu, gateway)):
        print(f"  {name:<20} {share:>6.1%}   {share * took_s / polls * 1e6:>8.0f}   {peak_mb(child.pid):>6.0f}")
    print()
    goals.most("polls that failed, as the gateway says", told[1], 0)
    goals.most(f"polls missed of {due * devices}", short, 0)
    goals.most(f"memory of {devices} devices that are polled", peak_mb(field.pid), MOST_MB, "MB")
    await control.aclose()


def cpu(field: Child, gateway: Child) -> tuple[float, float]:
    return cpu_s(field.pid), cpu_s(gateway.pid)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--devices", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="one start, 10 s")
    options = parser.parse_args()
    runs, seconds = (1, 10.0) if options.quick else (options.runs, options.seconds)
    goals = Goals()
    asyncio.run(compare_up(options.devices, runs, goals))
    print()
    asyncio.run(poll(options.devices, seconds, goals))
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
