"""A stopped program fails every scenario that does not expect it.

Defect: ST logic divided by zero in its first scan, and ``expect: {that: "not pump.fault", during: 30s}`` passed.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from tank_plant import DIVIDES_BY_ZERO, PLANT, PROTOTYPE, write_plant

from fieldtwin.reports.junit import write_junit
from fieldtwin.reports.run.html import write_html
from fieldtwin.results.model import Report, ScenarioResult, Verdict
from fieldtwin.run.targets.scenario_targets import ScenarioTarget, run_scenario
from fieldtwin.scenarios.language.form import load_scenario

WELL = DIVIDES_BY_ZERO.replace("3 / zero > 3", "FALSE AND zero > level")
LATER = DIVIDES_BY_ZERO.replace("3 / zero > 3", "100 / (level - 7) > 1000")
PYTHON = """from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, ScanInfo, var_input, var_local


class Pump(Program):
    level: float | None = var_input(TagKind.REAL)
    fault: bool = var_local(TagKind.BOOL, initial=False)

    def execute(self, scan: ScanInfo) -> None:
        raise ValueError("no such pump")
"""
NO_FAULT = "  - expect: {that: 'not pump.fault', during: 30s}\n"


def plant(folder: Path, logic: str, steps: str, head: str = "") -> Path:
    module = f"pump_{abs(hash(folder))}"  # a module is imported once per process
    source = f'"python: {module}:Pump"' if "class" in logic else "pump.st"
    (folder / (f"{module}.py" if "class" in logic else "pump.st")).write_text(logic)
    write_plant(folder, PLANT.replace("pump.st", source))
    path = folder / "x.scenario.yaml"
    path.write_text(f"scenario: the pump has no fault\nsystem: plant.yaml\n{head}steps:\n{steps}")
    return path


def run(path: Path, target: str = "virtual") -> ScenarioResult:
    return run_scenario(load_scenario(path), ScenarioTarget(target))


@pytest.mark.parametrize(
    ("logic", "place"),
    [(DIVIDES_BY_ZERO, "pump.st:9"), (PYTHON, ".py:10")],
    ids=["ST divides by zero in its first scan", "Python raises"],
)
@pytest.mark.parametrize("target", ["virtual", "local"])
def test_a_program_that_fails_in_its_first_scan_fails_the_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, logic: str, place: str, target: str
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    result = run(plant(tmp_path, logic, NO_FAULT), target)
    assert result.verdict is Verdict.FAILED, result.reason
    rule = result.checks[-1]
    assert rule.number == "running"
    assert rule.where.endswith(place)
    assert place in result.reason
    assert result.checks[0].verdict is Verdict.INCONCLUSIVE, "the step was not finished"


def test_the_same_scenario_passes_with_a_program_that_runs(tmp_path: Path) -> None:
    result = run(plant(tmp_path, WELL, NO_FAULT))
    assert result.verdict is Verdict.PASSED, result.checks


def test_a_program_that_stops_later_fails_unrelated_rules_and_steps(tmp_path: Path) -> None:
    steps = "  - pause: 1s\n  - set: {tag: sensor.level, value: 7}\n  - pause: 2s\n  - expect: {tag: sensor.level, value: 7}\n"
    result = run(plant(tmp_path, LATER, steps, "never: ['pump.fault']\n"))
    assert result.verdict is Verdict.FAILED
    assert (result.checks[-1].number, result.checks[-1].where[-9:]) == ("running", "pump.st:9")
    assert result.checks[-1].t_ns is not None
    assert 1.0 < result.checks[-1].t_ns / 1e9 < 2.0


def test_a_scenario_can_ask_for_a_program_that_stops(tmp_path: Path) -> None:
    steps = (
        "  - pause: 1s\n  - set: {tag: sensor.level, value: 7}\n"
        "  - expect: {that: \"quality(pump.fault) == 'bad'\", within: 2s}\n"
    )
    stops = run(plant(tmp_path, LATER, steps, "stopped: [plc]\n"))
    assert stops.verdict is Verdict.PASSED, stops.checks
    assert "pump.st:9" in stops.checks[-1].got
    runs = run(plant(tmp_path, WELL, "  - pause: 2s\n", "stopped: [plc]\n"))
    assert runs.verdict is Verdict.FAILED
    assert "the PLC did not stop" in runs.reason


@pytest.mark.long
def test_terminal_html_and_junit_name_file_and_line_of_the_logic(tmp_path: Path) -> None:
    path = plant(tmp_path, DIVIDES_BY_ZERO, NO_FAULT)
    result = run(path)
    report = Report("scenarios", [result], load_scenario(path).system)
    write_html(report, tmp_path / "r.html")
    write_junit(report, tmp_path / "r.xml")
    assert "pump.st:9" in (tmp_path / "r.html").read_text()
    failure = ET.parse(tmp_path / "r.xml").getroot().find(".//failure")
    assert failure is not None
    assert "pump.st:9" in failure.get("message", "")
    ended = subprocess.run(
        [sys.executable, "-m", "fieldtwin", "test", str(path)], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 1
    assert "pump.st:9" in ended.stdout.replace("\n", "")


FIELD = """class Tank:
    def __init__(self, start):
        pass

    def step(self, t_s, dt_s, inputs):
        return {"level": 1 / 0 if t_s > 1 else 42}
"""


def test_simulated_field_devices_that_fail_make_the_scenario_an_error_with_the_place(tmp_path: Path) -> None:
    path = plant(tmp_path, WELL, "  - pause: 5s\n  - expect: {that: 'not pump.fault'}\n")
    (tmp_path / "tank.py").write_text(FIELD)
    prototype = PROTOTYPE.replace(
        "devices:\n", "simulations:\n  tank: {python: tank.py:Tank, step_ms: 100}\ndevices:\n"
    )
    (tmp_path / "plant.prototype.yaml").write_text(
        prototype.replace("{model: profile, values: {level: 42}}", "{simulation: tank}")
    )
    result = run(path)
    assert result.verdict is Verdict.ERROR
    assert "tank.py" in result.reason
    assert "division by zero" in result.reason
    assert result.checks[-1].number == "running"
