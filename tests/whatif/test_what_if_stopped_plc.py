"""What-if with a PLC that stops, and requirements about what is unknown: neither may be met."""

from __future__ import annotations

from pathlib import Path

from fieldtwin.whatif.fork import Fork, answer
from fieldtwin.whatif.plan import Plan
from fieldtwin.whatif.state import KnownState

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
LOGIC = """PROGRAM Pump
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


def plan(name: str, *require: str) -> Plan:
    return Plan(name, require=require)


def test_a_plan_in_which_the_plc_stops_or_nothing_is_known_is_not_met(tmp_path: Path) -> None:
    """Observed before: ``not pump.fault`` was met by a PLC that divided by zero in its first scan."""
    (tmp_path / "pump.st").write_text(LOGIC)
    (tmp_path / "plant.yaml").write_text(PLANT)
    (tmp_path / "tank.yaml").write_text(
        "device: fieldtwin/tank\nsource: a test\nprotocol: modbus\nnumbering: sent\n"
        'tags:\n  level: {at: "holding:0", poll: level}\n'
    )
    (tmp_path / "plant.prototype.yaml").write_text(
        'prototype_of: plant.yaml\nbuses:\n  lan: {listen: "tcp://127.0.0.1:0"}\n'
        "devices:\n  sensor: {model: profile, values: {level: 42}}\n"
    )
    fork = Fork(str(tmp_path / "plant.yaml"), KnownState(), 10.0)
    stopped = answer(fork, plan("divides by zero", "not pump.fault"))
    assert not stopped.met
    assert "pump.st:9" in stopped.error
    (tmp_path / "pump.st").write_text(LOGIC.replace("3 / zero > 3", "level < 0"))
    assert answer(fork, plan("runs", "not pump.fault", "not (sensor.level > 100)")).met
    assert not answer(fork, plan("unknown", "not (sensor.level / 0 > 100)")).met
