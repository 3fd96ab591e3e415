"""A small pump station for tests: one drive whose speed is limited to 50 Hz, and a program that may ask for more."""

from __future__ import annotations

from pathlib import Path

PROFILE = """\
device: test/drive
source: "made up for a test"
protocol: modbus
limits: {functions: [3, 4, 6, 16]}
tags:
  pressure: {at: 30001, type: float32, unit: bar}
  speed: {at: 40001, type: float32, unit: Hz, access: rw, range: [0, 50]}
  run:   {at: 40003, type: uint16, access: rw, range: [0, 1]}
"""

SYSTEM = """\
fieldtwin: 1
system: station
buses:
  lan: {url: "tcp://drive:502", timeout_ms: 300}
devices:
  drive:
    profile: ./drive.yaml
    bus: lan
    unit: 1
    poll: {values: {every_ms: 100}}
    writable: [speed, run]
    safe: {run: 0}
plc:
  cycle_ms: 50
  programs:
    pump:
      source: "SOURCE"
      inputs: {pressure: {tag: drive.pressure}}
      outputs: {speed: drive.speed, go: drive.run}
"""

PROTOTYPE = """\
prototype_of: station.yaml
buses:
  lan: {listen: "tcp://127.0.0.1:0"}
devices:
  drive: {model: profile, values: {pressure: 2.5, speed: 20.0, run: 0}}
"""

TOO_FAST = """\
PROGRAM pump
VAR_INPUT pressure : REAL; END_VAR
VAR_OUTPUT speed : REAL := 20.0; go : INT; END_VAR
IF pressure > 2.0 THEN
  speed := 60.0;
  go := 1;
END_IF;
END_PROGRAM
"""
"""Request 60 Hz in line 5, and start the drive."""

TOO_FAST_PYTHON = """\
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, ScanInfo, var_input, var_output


class Pump(Program):
    pressure: float | None = var_input(TagKind.REAL)
    speed: float = var_output(TagKind.REAL)
    go: int = var_output(TagKind.INT)

    def execute(self, scan: ScanInfo) -> None:
        if self.pressure is not None and self.pressure > 2.0:
            self.set_speed(60.0)
            self.go = 1

    def set_speed(self, wanted: float) -> None:
        self.speed = wanted
"""


def written(
    folder: Path,
    program: str = TOO_FAST,
    *,
    system: str = SYSTEM,
    prototype: str = PROTOTYPE,
    module: str = "pump_control",
) -> Path:
    """Write the files of a station into `folder`; return the path of its system file. `module` is the name of a Python
    program, which is imported once per process."""
    python = "class Pump" in program
    (folder / "drive.yaml").write_text(PROFILE, encoding="utf-8")
    (folder / (f"{module}.py" if python else "pump.st")).write_text(program, encoding="utf-8")
    source = f"python: {module}:Pump" if python else "pump.st"
    (folder / "station.yaml").write_text(system.replace("SOURCE", source), encoding="utf-8")
    (folder / "station.prototype.yaml").write_text(prototype, encoding="utf-8")
    return folder / "station.yaml"


def scenario(folder: Path, steps: str = "  - pause: 2s\n", head: str = "") -> Path:
    """Return a scenario of the station."""
    path = folder / "pump.scenario.yaml"
    path.write_text(f"scenario: the pump\nsystem: station.yaml\n{head}steps:\n{steps}", encoding="utf-8")
    return path
