"""Every shipped Modbus profile of a real device in one system: its prototype replays the recordings of exchanges, and every
value that the gateway publishes is one that the device held."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from procs import fieldtwin, no_tracebacks, wait_for

SYSTEM = """
fieldtwin: 1
system: workshop
buses:
  meters: {url: "rtu:/dev/ttyUSB0?baudrate=9600&frame=8N1"}
  solar: {url: "rtu:/dev/ttyUSB1?baudrate=9600&frame=8N1"}
  water: {url: "rtu:/dev/ttyUSB2?baudrate=9600&frame=8N2"}
  roof: {url: "tcp://192.0.2.7:502"}
devices:
  meter: {profile: eastron-sdm630, bus: meters, unit: 1, poll: {fast: {every_ms: 500}}}
  drive: {profile: delta-vfd-e, bus: meters, unit: 2, poll: {values: {every_ms: 500}}}
  rover: {profile: renogy-rover, bus: solar, unit: 1, poll: {values: {every_ms: 500}}}
  probe: {profile: aqualabo-c4e, bus: water, unit: 30, poll: {values: {every_ms: 1000}}, writable: [measure]}
  inverter: {profile: sunspec-inverter-103, bus: roof, unit: 126, poll: {values: {every_ms: 500}}}
plc:
  programs:
    idle: {source: "python: idle:Idle", inputs: {}, outputs: {}}
"""
PROGRAM = """
from fieldtwin.plc.program import Program, ScanInfo


class Idle(Program):
    def execute(self, scan: ScanInfo) -> None:
        pass
"""
PROTOTYPE = """
prototype_of: workshop.yaml
buses:
  meters: {listen: "pty:meters"}
  solar: {listen: "pty:solar"}
  water: {listen: "pty:water"}
  roof: {listen: "tcp://127.0.0.1:0"}
devices:
  meter: {recording: eastron-sdm630.jsonl}
  drive: {recording: delta-vfd-e.jsonl}
  rover: {recording: renogy-rover.jsonl, identity: {model: "ROVER-20A"}}
  probe: {recording: aqualabo-c4e.jsonl}
  inverter: {recording: sunspec-inverter-103.jsonl}
"""


@pytest.mark.long
def test_a_prototype_of_real_devices(tmp_path: Path) -> None:
    folder = tmp_path / "systems"
    folder.mkdir()
    (folder / "workshop.yaml").write_text(SYSTEM, encoding="utf-8")
    (folder / "workshop.prototype.yaml").write_text(PROTOTYPE, encoding="utf-8")
    (folder / "idle.py").write_text(PROGRAM, encoding="utf-8")
    with fieldtwin(tmp_path / "run", "run", str(folder / "workshop.yaml"), "--prototype", "--json") as program:
        gateway = program.control("workshop", "gateway")

        def all_online() -> bool:
            devices = gateway("get")["devices"]
            return len(devices) == 5 and all(d["online"] for d in devices.values())

        wait_for(all_online, 20)
        wait_for(lambda: gateway("get")["tags"]["probe.conductivity"]["quality"] == "good", 10)
        tags = gateway("get")["tags"]
        assert tags["rover.model"]["value"] == "ROVER-20A"
        assert tags["inverter.current_l3"]["quality"] == "bad"  # not implemented there, as its value indicates
        assert 220 < tags["meter.voltage_l1"]["value"] < 240
        assert gateway("get")["published"] > 50
        wait_for(lambda: gateway("get")["published"] > 200, 10)
        program.signal(signal.SIGINT)
        assert program.wait(15) == 0, program.err
        published = program.summary["published"]
        assert published["checked"] > 200
        assert published["wrong"] == 0
    no_tracebacks(tmp_path / "run")
