"""A schedule that a campaign shrinks names the cause of the failure, and the written scenario is confirmed.

Defect: schedules of systems without a transmitter contained ``send`` steps and could never pass. The shrinker never tried a
run without faults, so a crash in the first scan was attributed to a fault at 244 s.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
from click.testing import CliRunner
from tank_plant import write_plant

from fieldtwin.cli.run.simulate_command import command as simulate_command
from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.run.campaigns.confirming import CONFIRMED
from fieldtwin.run.campaigns.shrink import same_failure, smallest
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.scenarios.language.form import load_scenario

PLANT = """fieldtwin: 1
system: plant
buses:
  lan: {url: "tcp://192.0.2.1:502", timeout_ms: 200}
devices:
  sensor: {profile: tank.yaml, bus: lan, unit: 1, poll: {level: {every_ms: 500}}, stale_after_ms: 2000}
plc:
  cycle_ms: 100
  programs:
    pump: {source: pump.st, inputs: {level: {tag: sensor.level}}}
"""
PROGRAM = """PROGRAM Pump
VAR_INPUT
  level : INT;
END_VAR
VAR
  zero  : INT;
  share : INT;
END_VAR
  %s
END_PROGRAM
"""
CRASHES_AT_ONCE = PROGRAM % "share := 3 / zero;"
CRASHES_ON_BAD_LEVEL = PROGRAM % "IF NOT IS_GOOD(level) THEN share := 3 / zero; END_IF;"
CORRECT = PROGRAM % "IF NOT IS_GOOD(level) THEN share := 0; END_IF;"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_plant(tmp_path, PLANT)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def campaign(program: str, seeds: str = "1..3") -> tuple[int, str]:
    Path("pump.st").write_text(program)
    words = ["plant.yaml", "--for", "6min", "--seeds", seeds, "--faults", "random"]
    told = CliRunner().invoke(simulate_command, words, standalone_mode=False)
    assert told.exception is None, told.output
    return told.return_value, told.output


def judged(folder: Path, program: str) -> tuple[ScenarioResult, str]:
    path = min(folder.glob("*.scenario.yaml"))
    (folder / "pump.st").write_text(program)
    return run_virtual(load_scenario(path)), path.read_text()


@pytest.mark.long
@pytest.mark.timeout(300)
def test_a_crash_in_the_first_scan_is_blamed_on_no_fault(folder: Path) -> None:
    code, told = campaign(CRASHES_AT_ONCE)
    assert code == 1
    assert "also fails without faults, so the faults are not the cause" in told
    assert CONFIRMED in told
    result, text = judged(folder, CRASHES_AT_ONCE)
    assert result.verdict is Verdict.FAILED
    assert "fault:" not in text
    assert "send" not in text
    result, _ = judged(folder, CORRECT)
    assert result.verdict is Verdict.PASSED, result.reason


@pytest.mark.long
@pytest.mark.timeout(300)
def test_a_crash_because_of_a_fault_is_blamed_on_that_fault(folder: Path) -> None:
    code, told = campaign(CRASHES_ON_BAD_LEVEL)
    assert code == 1
    assert "fails with 1 fault of its schedule; without faults the run passes" in told
    assert CONFIRMED in told
    result, text = judged(folder, CRASHES_ON_BAD_LEVEL)
    assert (result.verdict, text.count("fault:"), text.count("send")) == (Verdict.FAILED, 1, 0)
    result, _ = judged(folder, CORRECT)
    assert result.verdict is Verdict.PASSED, result.reason
    code, told = campaign(CORRECT)
    assert code == 0, told


def test_a_failure_that_needs_no_item_is_left_with_none() -> None:
    asked: list[Sequence[int]] = []

    def fails(part: Sequence[int]) -> bool:
        asked.append(part)
        return True

    assert smallest(range(40), fails) == ([], True)
    assert len(asked) == 1


def test_a_single_item_is_tried_without() -> None:
    assert smallest([7], lambda part: True) == ([], True)
    assert smallest([7], lambda part: 7 in part) == ([7], True)


def test_a_different_failure_is_not_taken_for_the_original_one() -> None:
    found = ["PLC: the program pump failed at 3.1 s", "x"]
    assert same_failure(found, ["PLC: the program pump failed at 244.0 s"])
    assert not same_failure(found, ["sensor: no reply for 3.1 s"])
    assert not same_failure(found, [])
