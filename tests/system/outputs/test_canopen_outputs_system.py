"""A PLC drives CANopen nodes of a prototype: a drive to its speed and an I/O module's outputs; killing the PLC stops both."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
from procs import fieldtwin, held_by, no_tracebacks, wait_for

SYSTEM = """\
fieldtwin: 1
system: winch
buses: {can0: {url: "can:socketcan/can0", bitrate: 500000}}
devices:
  drive:
    {profile: drive-cia402, bus: can0, node: 7, heartbeat: {producer_ms: 100, consumer_ms: 1000},
     tpdo1: {map: [statusword, velocity], event_ms: 50}, poll: {values: {every_ms: 500}}, start: true,
     writable: [controlword, target_velocity, mode], safe: {controlword: 2, target_velocity: 0},
     rpdo1: {map: [controlword, target_velocity], event_ms: 200}}
  io:
    {profile: io-cia401, bus: can0, node: 6, heartbeat: {producer_ms: 100, consumer_ms: 1000}, start: true,
     writable: [outputs_1, outputs_2, analogue_out_1], safe: {outputs_1: 0}, rpdos: node, poll: {values: {every_ms: 500}}}
plc:
  cycle_ms: 20
  programs:
    winch:
      source: "python: winch_control:Winch"
      inputs: {status: {tag: drive.statusword}, speed: {tag: drive.velocity}}
      outputs: {control: drive.controlword, target: drive.target_velocity, mode: drive.mode, lamp: io.outputs_1,
                level: io.analogue_out_1}
"""
PROTOTYPE = """\
prototype_of: winch.yaml
buses: {can0: {listen: "can:fieldtwin/127.0.0.1:0", pace: true}}
devices: {drive: {model: profile}, io: {model: profile}}
"""
PROGRAM = '''\
"""Brings the drive to Operation enabled, one arrow of CiA 402 at a time, and lights a lamp while it turns."""

from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, ScanInfo, var_input, var_output

NEXT = {0x40: 6, 0x21: 7, 0x23: 15, 0x27: 15, 0x08: 128}


class Winch(Program):
    status: int | None = var_input(TagKind.INT)
    speed: int | None = var_input(TagKind.INT)
    control: int = var_output(TagKind.INT, initial=0)
    target: int = var_output(TagKind.INT, initial=0)
    mode: int = var_output(TagKind.INT, initial=3)
    lamp: int = var_output(TagKind.INT, initial=0)
    level: float = var_output(TagKind.REAL, initial=2.5)

    def execute(self, scan: ScanInfo) -> None:
        if self.status is None:
            return
        self.control = NEXT.get(self.status & 0x6F, 0)
        self.target = 1500 if self.status & 0x6F == 0x27 else 0
        self.lamp = 0x81 if self.speed else 0
'''


def write(folder: Path) -> str:
    for name, text in (("winch.yaml", SYSTEM), ("winch.prototype.yaml", PROTOTYPE), ("winch_control.py", PROGRAM)):
        (folder / name).write_text(text, encoding="utf-8")
    return str(folder / "winch.yaml")


@pytest.mark.long
def test_a_plc_runs_a_drive_and_a_killed_plc_leaves_it_stopped(tmp_path: Path) -> None:
    system = write(tmp_path)
    with fieldtwin(tmp_path, "run", system, "--prototype", "--instance", "w", "--json") as run:
        gateway, field = run.control("w", "gateway"), run.control("w", "field")
        wait_for(lambda: gateway("get")["tags"]["drive.velocity"]["value"] == 1500, 15, "the speed")
        wait_for(lambda: held_by(field, "io", "outputs_1")[-1] == "81", 5, "the lamp")
        wait_for(lambda: held_by(field, "io", "analogue_out_1")[-1] == "0020", 5, "2.5 V")
        status = gateway("get")
        assert status["devices"]["drive"]["rpdos"] == {"1": ["controlword", "target_velocity"]}
        assert status["devices"]["io"]["rpdos"] == {"1": ["outputs_1", "outputs_2"]}
        assert status["tags"]["drive.statusword"]["value"] & 0x6F == 0x27
        assert status["buses"]["can0"]["not_produced"] == 0
        os.kill(run.pid_of("w", "plc"), signal.SIGKILL)
        wait_for(lambda: gateway("get")["tags"]["drive.velocity"]["value"] == 0, 5, "the drive stops")
        wait_for(lambda: held_by(field, "io", "outputs_1")[-1] == "00", 5, "the lamp goes out")
        after = {o["tag"]: (o["held"], o["by"]) for o in gateway("get")["outputs"]}
        assert after["drive.controlword"] == (2, "safe: the PLC's heartbeat was lost")
        assert after["io.analogue_out_1"] == (2.5, "plc")  # it has no safe value
        run.signal(signal.SIGINT)
        assert run.wait(6) == 1
    lines = [json.loads(line) for line in (tmp_path / "w" / "audit.jsonl").read_text(encoding="utf-8").splitlines()]
    done = [line["new"] for line in lines if line.get("tag") == "drive.controlword" and line["result"] == "done"]
    assert [value for value in done if value in (6, 7, 15, 2)][-1] == 2
    assert {6, 7, 15} <= set(done)
    no_tracebacks(tmp_path)
