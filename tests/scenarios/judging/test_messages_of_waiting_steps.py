"""Messages of a failed step and of a waiting program: "now" instead of "within 0 s", and the remedy for a program that waits
for an input that only its own command changes."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from fieldtwin.cli.main import cli
from fieldtwin.results.model import Verdict
from fieldtwin.run.targets.scenario_targets import ScenarioTarget, run_scenario
from fieldtwin.scenarios.language.form import load_scenario
from fieldtwin.twin.site.system import load_system

ROOT = Path(__file__).resolve().parents[3]
MOORING = """fieldtwin: 1
system: mooring
buses:
  lan: {url: "tcp://192.0.2.1:502", timeout_ms: 500}
devices:
  ctd:
    profile: ctd-reference
    bus: lan
    unit: 1
    poll: {values: {every_ms: 250}, status: {every_ms: 250}}
    writable: [sample_period_s]
plc:
  cycle_ms: 100
  programs:
    sampling:
      source: sampling.st
      START
      inputs: {pressure: {tag: ctd.pressure, if_bad: IF_BAD}}
      outputs: {period_s: ctd.sample_period_s}
"""
LOGIC = """PROGRAM Sampling
  VAR_INPUT pressure : REAL; END_VAR
  VAR_OUTPUT period_s : INT; END_VAR
  period_s := 1;
END_PROGRAM
"""
PROTOTYPE = """prototype_of: mooring.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
simulations: {sea: {step_ms: 100, formulas: {pressure: "10", temperature: "4", conductivity: "3"}}}
devices: {ctd: {simulation: sea}}
"""


def mooring(folder: Path, start: str = "", if_bad: str = "hold") -> Path:
    (folder / "sampling.st").write_text(LOGIC)
    (folder / "mooring.yaml").write_text(MOORING.replace("START", start or "start: {}").replace("IF_BAD", if_bad))
    (folder / "mooring.prototype.yaml").write_text(PROTOTYPE)
    return folder / "mooring.yaml"


def judged(folder: Path, steps: str) -> tuple[Verdict, str, str, str]:
    path = folder / "x.scenario.yaml"
    path.write_text(f"scenario: x\nsystem: mooring.yaml\nsteps:\n{steps}")
    result = run_scenario(load_scenario(path), ScenarioTarget())
    check = next(check for check in result.checks if check.verdict is result.verdict)
    return result.verdict, check.expected, check.got, result.reason


ANYWAY = "start: {timeout_ms: 1000, at_timeout: start_anyway}"


@pytest.mark.parametrize(("within", "said"), [("", " now"), (", within: 2s", " within 2 s")])
def test_a_step_without_within_is_about_now(tmp_path: Path, within: str, said: str) -> None:
    mooring(tmp_path, ANYWAY)
    steps = f"  - pause: 10s\n  - expect: {{that: 'ctd.pressure > 99'{within}}}\n"
    verdict, expected, _, _ = judged(tmp_path, steps)
    assert (verdict, expected) == (Verdict.FAILED, f"ctd.pressure > 99{said}")


def test_a_program_that_waits_for_its_own_command_is_named_when_the_file_is_loaded(tmp_path: Path) -> None:
    path = mooring(tmp_path)
    (warning,) = load_system(str(path)).warnings
    assert f"{path}:18" in warning
    assert "program sampling waits for ctd.pressure before its first scan" in warning
    assert "ctd measures only after this program has written ctd.sample_period_s" in warning
    assert "`start: {timeout_ms: 1000, at_timeout: start_anyway}` in sampling" in warning
    told = CliRunner().invoke(cli, ["simulate", str(path), "--for", "2s"])
    assert "measures only after" in " ".join(told.output.split())
    verdict, _, _, reason = judged(tmp_path, "  - pause: 30s\n  - expect: {that: 'ctd.pressure == 10'}\n")
    assert verdict is Verdict.FAILED
    assert "a device that measures only after this program has commanded it needs `at_timeout: start_anyway`" in reason


@pytest.mark.parametrize(("start", "if_bad"), [(ANYWAY, "hold"), ("", "0")])
def test_a_program_that_starts_without_the_value_gives_no_warning(tmp_path: Path, start: str, if_bad: str) -> None:
    assert load_system(str(mooring(tmp_path, start, if_bad))).warnings == ()
    verdict, _, _, _ = judged(tmp_path, "  - pause: 30s\n  - expect: {that: 'ctd.pressure == 10'}\n")
    assert verdict is Verdict.PASSED


SHIPPED = [*(ROOT / "profiles" / "systems").glob("*.yaml"), *(ROOT / "examples").glob("*/*.yaml")]
SYSTEMS = [path for path in SHIPPED if "\nsystem: " in f"\n{path.read_text()}" and ".scenario." not in path.name]


@pytest.mark.parametrize("path", SYSTEMS, ids=lambda path: path.stem)
def test_no_shipped_system_has_such_a_program(path: Path) -> None:
    assert not [one for one in load_system(str(path)).warnings if "measures only after" in one]
