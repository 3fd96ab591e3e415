"""A plant with one level sensor in a tank and a program called pump; used by the tests of programs that stop or crash."""

from __future__ import annotations

from pathlib import Path

PROFILE = """device: fieldtwin/tank
source: "made for this test"
protocol: modbus
numbering: sent
tags:
  level: {at: "holding:0", poll: level}
"""
PLANT = """fieldtwin: 1
system: plant
buses:
  lan: {url: "tcp://192.0.2.1:502"}
devices:
  sensor: {profile: tank.yaml, bus: lan, unit: 1, poll: {level: {every_ms: 100}}}
plc:
  cycle_ms: 50
  programs:
    pump: {source: pump.st, inputs: {level: {tag: sensor.level}}}
"""
PROTOTYPE = """prototype_of: plant.yaml
buses:
  lan: {listen: "tcp://127.0.0.1:0"}
devices:
  sensor: {model: profile, values: {level: 42}}
"""
DIVIDES_BY_ZERO = """PROGRAM Pump
VAR_INPUT
  level : INT;
END_VAR
VAR
  zero  : INT;
  fault : BOOL;
END_VAR
  fault := 3 / zero > 3;
END_PROGRAM
"""
"""It stops in its first scan, at line 9."""


def write_plant(folder: Path, plant: str = PLANT) -> None:
    """Write the profile, the system file and the prototype file; the caller writes the program."""
    for name, text in (("tank.yaml", PROFILE), ("plant.yaml", plant), ("plant.prototype.yaml", PROTOTYPE)):
        (folder / name).write_text(text)
