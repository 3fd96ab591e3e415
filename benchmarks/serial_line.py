#!/usr/bin/env python3
"""A serial line at 19200 baud 8E1, modelled on a pty: how close to its theoretical rate are polls in real time?

    benchmarks/serial_line.py [--runs 5] [--seconds 10] [--quick]

A separate process simulates the line and the device: characters, the 3.5 characters of silence, 5 ms of response time. One
device with 10 registers is polled as often as the line allows, by our gateway (also a process, with a period of 1 ms, so that
a poll is always due), and by minimalmodbus in a bare loop, the peer. In theory a poll takes 8 characters, 5 ms, 25 characters,
and 3.5 characters of silence. The device counts the polls. Runs alternate; the results are medians. The exit status is 1 if
the goal is missed. Needs an idle machine.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import msgspec
from peers import Goals, python, ratio

from fieldtwin.emulators.wires.serial_line import SerialPacer
from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.run.processes.children import Child
from fieldtwin.twin.plant.controller import ControllerConfig
from fieldtwin.twin.plant.mapping import mapped_endpoint, mapping_to_json
from fieldtwin.twin.plant.physical import image_layout, make_image
from fieldtwin.twin.prototype.field_process import FieldConfig
from fieldtwin.twin.site.system import load_system

LINE, LATENCY_MS, REGISTERS = SerialSettings(19200, "8E1"), 5, 10
REQUEST_CHARS, REPLY_CHARS = 8, 5 + 2 * REGISTERS
WARM_UP_S, GOAL = 1.0, 0.97
FILES = {
    "idle_program.py": """
from fieldtwin.plc.program import Program

class Idle(Program):
    def execute(self, scan):
        pass
""",
    "ten.yaml": """
device: benchmark/ten
source: "made for a benchmark: ten registers"
protocol: modbus
factory: {unit: 1}
numbering: sent
defaults: {type: uint16, poll: values}
tags:
  value_1..10: {at: "holding:0"}
""",
    "line.yaml": """
fieldtwin: 1
system: line
buses:
  line1: {url: "rtu:/dev/ttyBENCH?baudrate=19200&frame=8E1"}
devices:
  ten: {profile: ten.yaml, bus: line1, unit: 1, poll: {values: {every_ms: 1}}}
plc:
  cycle_ms: 100
  programs:
    idle: {source: "python: idle_program:Idle"}
""",
    "line.prototype.yaml": f"""
prototype_of: line.yaml
buses:
  line1: {{listen: "pty:line1", pace: true}}
devices:
  ten: {{recording: ten.jsonl, latency_ms: {LATENCY_MS}}}
""",
}
MASTER = """
import sys, minimalmodbus
device = minimalmodbus.Instrument(sys.argv[1], 1)  # 19200 baud; without parity, which a pty has not: the model counts its bit
device.serial.timeout = 1.0
while True:
    assert len(device.read_registers(0, 10)) == 10
"""


def theory_per_s() -> float:
    """Return the polls per second that the line allows."""
    line = SerialPacer(LINE)
    took_ns = line.duration_ns(REQUEST_CHARS) + LATENCY_MS * 1_000_000 + line.duration_ns(REPLY_CHARS) + line.t3_5_ns
    return 1e9 / took_ns


def make_files(folder: Path) -> Path:
    for name, text in FILES.items():
        (folder / name).write_text(text)
    exchange = {
        "t": 0.0,
        "unit": 1,
        "req": f"030000{REGISTERS:04x}",
        "rep": f"03{2 * REGISTERS:02x}" + "002a" * REGISTERS,
    }
    header = {"fieldtwin_recording": 1, "device": "benchmark/ten", "kind": "exchanges", "source": "synthetic"}
    (folder / "ten.jsonl").write_text("".join(json.dumps(line) + "\n" for line in (header, exchange | {"lat": 0.02})))
    return folder / "line.yaml"


async def counted_per_s(client: ControlClient, seconds: float) -> float:
    """Return the device's replies per second, by its own count."""
    await asyncio.sleep(WARM_UP_S)
    counts: list[tuple[float, int]] = []
    for wait_s in (seconds, 0.0):
        status = await client.call("get")
        counts.append((time.perf_counter(), status["devices"]["ten"]["counters"]["replies"]))
        await asyncio.sleep(wait_s)
    (t0, n0), (t1, n1) = counts
    return (n1 - n0) / (t1 - t0)


async def one_run(folder: Path, seconds: float) -> tuple[float, float]:
    """Return the gateway's rate, then minimalmodbus's, on the same emulated line."""
    path = make_files(folder)
    config = folder / "field.json"
    config.write_bytes(msgspec.json.encode(FieldConfig(str(path), str(folder))))
    field = Child("field", "fieldtwin.twin.prototype.field_process", config, folder)
    client = await field.connect()
    try:
        return await gateway_rate(folder, path, client, seconds), await peer_rate(folder, client, seconds)
    finally:
        await client.aclose()
        await field.end()


async def gateway_rate(folder: Path, path: Path, client: ControlClient, seconds: float) -> float:
    system = load_system(str(path))
    make_image(image_layout(system), folder / "image")
    plant = system.buses["line1"].endpoint
    listening = Endpoint.parse((await client.call("get"))["listening"]["line1"])
    mapping = mapping_to_json({plant: mapped_endpoint(plant, listening)})
    config = folder / "gateway.json"
    config.write_bytes(msgspec.json.encode(ControllerConfig(str(path), str(folder), False, mapping)))
    gateway = Child("gateway", "fieldtwin.twin.plant.controller", config, folder)
    try:
        control = await gateway.connect()
        rate = await counted_per_s(client, seconds)
        status = await control.call("get")
        await control.aclose()
        assert status["devices"]["ten"]["online"], status["devices"]["ten"]
        return rate
    finally:
        await gateway.end(5.0)


async def peer_rate(folder: Path, client: ControlClient, seconds: float) -> float:
    process = await asyncio.create_subprocess_exec(python(), "-c", MASTER, str(folder / "line1"))
    try:
        return await counted_per_s(client, seconds)
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--quick", action="store_true", help="one run of 3 s")
    options = parser.parse_args()
    runs, seconds = (1, 3.0) if options.quick else (options.runs, options.seconds)
    theory = theory_per_s()
    ours: list[float] = []
    theirs: list[float] = []
    for _ in range(runs):
        with tempfile.TemporaryDirectory(prefix="ft-line-") as name:
            mine, other = asyncio.run(one_run(Path(name), seconds))
        ours.append(mine)
        theirs.append(other)
    print(f"polls/s (theory {theory:.2f})   median   share of theory")
    for name, rates in (("fieldtwin gateway", ours), ("minimalmodbus", theirs)):
        print(f"  {name:<22} {median(rates):>6.2f}   {median(rates) / theory:>6.1%}")
    print(f"  ratio                  {ratio(ours, theirs):>6.2f}\n")
    goals = Goals()
    goals.least("share of the line's theoretical rate", median(ours) / theory, GOAL)
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
