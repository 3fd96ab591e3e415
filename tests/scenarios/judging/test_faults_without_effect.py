"""Scenarios report how often each fault took effect; a fault that never took effect has tested nothing.

Defect: faults that matched no frame left the scenario PASSED, and a campaign whose random schedules were all empty ended with
"ok".
"""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from click.testing import CliRunner

from fieldtwin.cli.run.simulate_command import command as simulate_command
from fieldtwin.cli.test.test_command import command as judge_command
from fieldtwin.reports.junit import write_junit
from fieldtwin.reports.run.html import write_html
from fieldtwin.results.model import Report, ScenarioResult, Verdict
from fieldtwin.run.targets.scenario_targets import ScenarioTarget, run_scenario
from fieldtwin.scenarios.language.form import load_scenario

GOOD = "  - wait: {until: \"quality(inclinometer.slope_long) == 'good'\", within: 10s}\n"
CLEARED = "  - clear: f\n"


def written(folder: Path, steps: str) -> Path:
    path = folder / "x.scenario.yaml"
    path.write_text(f"scenario: a test\nsystem: observatory\nsteps:\n{steps}")
    return path


def run(folder: Path, steps: str, target: str = "virtual") -> ScenarioResult:
    return run_scenario(load_scenario(written(folder, steps)), ScenarioTarget(target))


def fault(said: str) -> str:
    return f"  - fault: {{id: f, {said}}}\n  - pause: 3s\n"


@pytest.mark.parametrize(
    ("said", "strikes"),
    [
        ("name: lost-frame, device: inclinometer", True),
        ("name: lost-frame, device: inclinometer, cob_id: 0x7F", False),
        ("name: silence, device: modem, function: 23", False),
        ("name: silence, device: modem, from: 1h", False),
        ("name: wrong-function, device: ctd, function: 4, code: 4", False),
        ("name: drift, device: inclinometer, register: slope_long, per_s: 1", True),
    ],
)
@pytest.mark.parametrize("cleared", ["", CLEARED])
def test_a_fault_that_never_struck_makes_a_scenario_inconclusive(
    tmp_path: Path, said: str, strikes: bool, cleared: str
) -> None:
    result = run(tmp_path, GOOD + fault(said) + cleared)
    (one,) = result.faults
    assert (one.struck > 0, one.id) == (strikes, "f")
    assert result.verdict is (Verdict.PASSED if strikes else Verdict.INCONCLUSIVE), result.reason
    if not strikes:
        assert "fault f" in result.reason
        assert result.checks[-1].where.endswith("x.scenario.yaml:5")
        optional = run(tmp_path, GOOD + fault(f"{said}, optional: true") + cleared)
        assert (optional.verdict, optional.faults[0].struck) == (Verdict.PASSED, 0)


def test_a_failure_stays_a_failure_and_also_reports_its_faults(tmp_path: Path) -> None:
    steps = GOOD + fault("name: silence, device: modem, from: 1h")
    result = run(tmp_path, steps + "  - expect: {tag: inclinometer.slope_long, quality: bad}\n")
    assert result.verdict is Verdict.FAILED
    assert result.reason.startswith("step 4: ")
    assert result.faults[0].struck == 0


@pytest.mark.long
def test_faults_are_counted_in_processes_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    idle = "  - fault: {id: idle, name: silence, device: modem, function: 23}\n"
    result = run(tmp_path, GOOD + fault("name: lost-frame, device: inclinometer") + CLEARED + idle, "local")
    assert [(one.id, one.struck > 0) for one in result.faults] == [("f", True), ("idle", False)]
    assert result.verdict is Verdict.INCONCLUSIVE, result.reason


def test_terminal_json_junit_and_html_report_the_counts(tmp_path: Path) -> None:
    path = written(tmp_path, GOOD + fault("name: lost-frame, device: inclinometer"))
    told = CliRunner().invoke(judge_command, [str(path)], standalone_mode=False)
    assert "fault f (lost-frame on inclinometer): took effect" in told.output
    plain = json.loads(CliRunner().invoke(judge_command, [str(path), "--json"], standalone_mode=False).output)
    assert plain[0]["faults"][0]["struck"] > 0
    result = run(tmp_path, GOOD + fault("name: lost-frame, device: inclinometer"))
    report = Report("scenarios", [result], load_scenario(path).system)
    write_junit(report, tmp_path / "r.xml")
    write_html(report, tmp_path / "r.html")
    properties = ET.parse(tmp_path / "r.xml").getroot().findall(".//testcase/properties/property[@name='fault']")
    assert [one.get("value") for one in properties] == [result.faults[0].text]
    assert result.faults[0].text in (tmp_path / "r.html").read_text()


def test_a_run_reports_how_often_each_of_its_faults_took_effect(tmp_path: Path) -> None:
    faults = tmp_path / "faults.yaml"
    faults.write_text(
        "faults:\n  - {id: lost, name: lost-frame, device: inclinometer, from: 2s, until: 4s}\n"
        "  - {id: idle, name: silence, device: modem, function: 23}\n"
    )
    words = ["observatory", "--for", "5s", "--faults", str(faults)]
    told = CliRunner().invoke(simulate_command, words, standalone_mode=False)
    assert "lost (lost-frame on inclinometer): took effect" in told.output
    assert "idle (silence on modem): never took effect" in told.output
    summary = json.loads(CliRunner().invoke(simulate_command, [*words, "--json"], standalone_mode=False).stdout)
    assert [(one["id"], one["struck"] > 0) for one in summary["faults"]] == [("lost", True), ("idle", False)]


@pytest.mark.long
@pytest.mark.parametrize(("seeds", "for_", "ended"), [("1..2", "10s", "inconclusive"), ("3..4", "6min", "ok")])
def test_a_campaign_reports_how_often_faults_took_effect_and_needs_one(seeds: str, for_: str, ended: str) -> None:
    words = ["observatory", "--for", for_, "--seeds", seeds, "--faults", "random"]
    told = CliRunner().invoke(simulate_command, [*words, "--jobs", "1"], standalone_mode=False)
    assert told.output.rstrip().endswith(ended)
    assert told.return_value == (0 if ended == "ok" else 1)
    assert ("none was injected" in told.output) == (ended == "inconclusive")
