"""A site with one level sensor in a well, a program and two invariants; used by the tests of invariants on live targets.

The invariant `never` is broken when the limit in the program is below the level, which is 42.
"""

from __future__ import annotations

from pathlib import Path

_PROFILE = """device: own/well
source: "made for this test"
protocol: modbus
numbering: sent
tags:
  level: {at: "holding:0", poll: level}
"""
_SYSTEM = """fieldtwin: 1
system: NAME
buses:
  lan: {url: "URL"}
devices:
  sensor: {profile: well.yaml, bus: lan, unit: 1, poll: {level: {every_ms: 200}}}
plc:
  cycle_ms: 50
  watchdog: {late_ms: 2000, stop_after: 1000}
  programs:
    well: {source: well.st, inputs: {level: {tag: sensor.level}}}
invariants:
  always: ["sensor.level < 1000"]
  never: ["well.runs and sensor.level == 42"]
"""
_PROTOTYPE = """prototype_of: NAME.yaml
buses:
  lan: {listen: "tcp://127.0.0.1:0"}
devices:
  sensor: {model: profile, values: {level: 42}}
"""
_PROGRAM = """PROGRAM Well
VAR_INPUT
  level : INT;
END_VAR
VAR
  runs : BOOL;
END_VAR
  runs := level > LIMIT;
END_PROGRAM
"""
_SCENARIO = """scenario: the well
system: NAME.yaml
steps:
  - wait: {until: "sensor.level == 42", within: 60s}
  - pause: 2s
"""


def write_site(folder: Path, name: str, url: str) -> None:
    """Write all files except the program. The system is called `name`, and its sensor is at `url`."""
    (folder / "well.yaml").write_text(_PROFILE)
    (folder / f"{name}.yaml").write_text(_SYSTEM.replace("NAME", name).replace("URL", url))
    (folder / f"{name}.prototype.yaml").write_text(_PROTOTYPE.replace("NAME", name))
    (folder / "well.scenario.yaml").write_text(_SCENARIO.replace("NAME", name))


def write_program(folder: Path, limit: str) -> None:
    """Write the program, which reports that it runs while the level is above `limit`."""
    (folder / "well.st").write_text(_PROGRAM.replace("LIMIT", limit))
