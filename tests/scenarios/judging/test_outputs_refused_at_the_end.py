"""A scenario that is met at once still detects refused outputs of the first scan.

Defect: its only step was met after 4 ms, so it passed three times out of four although the program commanded an output that
was refused in its first scan. In virtual time the same scenario failed because the program "waits for" an input that had been
read: its first scan was still to come.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.results.model import Verdict
from fieldtwin.run.targets.scenario_targets import ScenarioTarget, run_scenario
from fieldtwin.scenarios.language.form import load_scenario

PROFILE = """device: own/heater
source: "this test"
protocol: modbus
numbering: printed
defaults: {poll: values}
tags:
  temperature: {at: 30001, type: float32}
  speed: {at: 40002, type: float32, access: rw, range: [0, 50]}
"""
SYSTEM = """fieldtwin: 1
system: heat
buses: {lan: {url: "tcp://heater:502"}}
devices: {heater: {profile: heater.yaml, bus: lan, unit: 1, poll: {values: {every_ms: 200}}, writable: [speed]}}
plc:
  cycle_ms: 50
  programs:
    ctl: {source: ctl.st, inputs: {temperature: {tag: heater.temperature}}, outputs: {speed: heater.speed}}
"""
PROTOTYPE = """prototype_of: heat.yaml
unmapped: refuse
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices: {heater: {model: profile, values: {temperature: 21.6}}}
"""
PROGRAM = """PROGRAM ctl
  VAR_INPUT temperature : REAL; END_VAR
  VAR_OUTPUT speed : REAL; END_VAR
  speed := SPEED;
END_PROGRAM
"""
SCENARIO = """scenario: it is warm
system: heat.yaml
steps:
  - expect: {that: "heater.temperature > 20", within: 5s}
"""


@pytest.mark.parametrize(("speed", "verdict"), [("60.0", Verdict.FAILED), ("40.0", Verdict.PASSED)])
def test_an_output_that_is_refused_in_the_first_scan_is_detected(tmp_path: Path, speed: str, verdict: Verdict) -> None:
    (tmp_path / "heater.yaml").write_text(PROFILE)
    (tmp_path / "heat.yaml").write_text(SYSTEM)
    (tmp_path / "heat.prototype.yaml").write_text(PROTOTYPE)
    (tmp_path / "ctl.st").write_text(PROGRAM.replace("SPEED", speed))
    (tmp_path / "warm.scenario.yaml").write_text(SCENARIO)
    result = run_scenario(load_scenario(tmp_path / "warm.scenario.yaml"), ScenarioTarget("virtual"))
    assert result.verdict is verdict, result.reason
    assert ("heater.speed = 60 did not reach the device" in result.reason) is (verdict is Verdict.FAILED)
