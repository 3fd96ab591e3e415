"""A simulation in Python that raises an exception fails the scenario and the run, and both name file, line and exception.

Defect: on the target `local` the exception ended only the gateway's connection. The simulated devices remained, and a scenario
that looked at the last value passed.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from fieldtwin.results.model import Verdict
from fieldtwin.run.targets.scenario_targets import ScenarioTarget, run_scenario
from fieldtwin.scenarios.language.form import load_scenario

FILES = {
    "pond.py": """class Pond:
    def __init__(self, start):
        pass

    def step(self, t_s, dt_s, inputs):
        if t_s > 1:
            raise ValueError("no pond")
        return {"level": 1.0}
""",
    "pond.yaml": """fieldtwin: 1
system: pond
buses: {lan: {url: "tcp://127.0.0.1:5020"}}
devices:
  gauge: {bus: lan, profile: ./gauge.yaml, unit: 1, poll: {values: {every_ms: 200}}}
plc:
  tasks: {main: {interval_ms: 50}}
  programs:
    watch: {source: watch.st, task: main, inputs: {level: {tag: gauge.level}}}
""",
    "gauge.yaml": """device: test/gauge
source: "a test"
protocol: modbus
numbering: sent
limits: {functions: [3]}
defaults: {type: float32, order: ABCD}
tags:
  level: {at: "holding:0", unit: m}
""",
    "watch.st": """PROGRAM watch
VAR_INPUT level : REAL; END_VAR
VAR high : BOOL; END_VAR
high := level > 2.0;
END_PROGRAM
""",
    "pond.prototype.yaml": """prototype_of: pond.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
simulations:
  pond: {python: "pond.py:Pond", step_ms: 50}
devices:
  gauge: {simulation: pond}
""",
    "low.scenario.yaml": """scenario: the level stays low
system: pond.yaml
steps:
  - expect: {that: "gauge.level < 2", during: 5s}
""",
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.mark.long
@pytest.mark.parametrize("fails_after_s", ["0.0", "0.3"])
def test_a_failure_while_the_system_starts_is_named_too(folder: Path, fails_after_s: str) -> None:
    """The connection to the simulated devices can be lost before their process has ended, which has the reason."""
    program = folder / "pond.py"
    program.write_text(program.read_text().replace("t_s > 1", f"t_s > {fails_after_s}"))
    result = run_scenario(load_scenario(folder / "low.scenario.yaml"), ScenarioTarget("local"))
    assert result.verdict is Verdict.ERROR, result
    assert "in line 7: ValueError: no pond" in result.reason


@pytest.mark.parametrize("target", ["virtual", "local"])
def test_a_scenario_fails_and_names_file_line_and_exception(folder: Path, target: str) -> None:
    result = run_scenario(load_scenario(folder / "low.scenario.yaml"), ScenarioTarget(target))
    assert result.verdict is Verdict.ERROR, result
    assert "pond.py:Pond" in result.reason
    assert "in line 7: ValueError: no pond" in result.reason


@pytest.mark.long
def test_a_run_names_it_in_its_errors(folder: Path) -> None:
    command = [sys.executable, "-m", "fieldtwin", "run", "pond.yaml", "--prototype", "--for", "3s", "--json"]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=60)
    assert ended.returncode == 1, ended.stderr
    assert "socket.send() raised exception" not in ended.stderr
    assert any("in line 7: ValueError: no pond" in error for error in json.loads(ended.stdout)["errors"])
