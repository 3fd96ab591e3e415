"""``set`` on an object that the simulation does not feed, or that a sampling sensor counts itself.

Defect: such a ``set`` had no effect and gave no message.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.run.targets.scenario_targets import ScenarioTarget, run_scenario
from fieldtwin.scenarios.language.form import load_scenario

ACTIVE = "  - send: {period_s: 1}\n  - wait: {until: \"quality(ctd.pressure) == 'good'\", within: 15s}\n"


def run(folder: Path, system: str, steps: str) -> ScenarioResult:
    path = folder / "x.scenario.yaml"
    path.write_text(f"scenario: a test\nsystem: {system}\nsteps:\n{steps}")
    return run_scenario(load_scenario(path), ScenarioTarget())


@pytest.mark.parametrize(
    ("tag", "value", "back"),
    [("ctd.sample_count", 4711, "< 1000"), ("ctd.status", 7, "== 1"), ("ctd.instrument_time", 5, "> 1000")],
)
def test_values_that_a_sensor_counts_itself_can_be_set_and_released(
    tmp_path: Path, tag: str, value: int, back: str
) -> None:
    steps = (
        f"  - wait: {{until: '{tag} {back}', within: 15s}}\n"
        f"  - set: {{tag: {tag}, value: {value}}}\n"
        f"  - expect: {{tag: {tag}, value: {value}, quality: good, within: 15s, during: 2s}}\n"
        f"  - set: {{tag: {tag}, value: null}}\n"
        f"  - expect: {{that: '{tag} {back}', within: 15s}}\n"
    )
    result = run(tmp_path, "observatory", ACTIVE + steps)
    assert result.verdict is Verdict.PASSED, result.checks[-1]


FED = """prototype_of: observatory.yaml
buses:
  line1: {listen: "pty:line1", pace: true}
  can0:  {listen: "can:fieldtwin/127.0.0.1:0"}
  lan:   {listen: "tcp://127.0.0.1:0"}
simulations:
  sea: {step_ms: 100, formulas: {slope_long: "sine(0, 1, 60)"}}
devices:
  ctd:          {recording: cast.jsonl, identity: {serial: "0042"}}
  inclinometer: {simulation: sea, identity: {serial: "1005"}}
  modem:        {model: mailbox, far: "tcp://127.0.0.1:0"}
"""


def test_an_object_that_no_simulation_feeds_can_be_set_and_given_back(tmp_path: Path) -> None:
    (tmp_path / "sea.prototype.yaml").write_text(FED)
    steps = (
        "  - wait: {until: \"quality(inclinometer.slope_lateral) == 'good'\", within: 5s}\n"
        "  - set: {tag: inclinometer.slope_lateral, value: 12.5}\n"
        "  - expect: {tag: inclinometer.slope_lateral, value: 12.5, tolerance: 0.01, within: 3s, during: 1s}\n"
        "  - set: {tag: inclinometer.slope_long, value: 20}\n"
        "  - expect: {tag: inclinometer.slope_long, value: 20, tolerance: 0.01, within: 3s, during: 1s}\n"
        "  - set: {tag: inclinometer.slope_lateral, value: null}\n"
        "  - expect: {that: 'inclinometer.slope_lateral < 1', within: 3s}\n"
    )
    path = tmp_path / "x.scenario.yaml"
    path.write_text(
        f"scenario: a test\nsystem: observatory\nprototype: sea.prototype.yaml\njudge: run\nsteps:\n{steps}"
    )
    result = run_scenario(load_scenario(path), ScenarioTarget())
    assert result.verdict is Verdict.PASSED, result.checks[-1]


def test_a_set_value_without_effect_is_reported(tmp_path: Path) -> None:
    """The sensor is in standby and takes no samples, so its signal never gets the set value."""
    steps = "  - wait: {until: \"quality(inclinometer.slope_long) == 'good'\", within: 5s}\n"
    result = run(tmp_path, "observatory", steps + "  - set: {tag: ctd.pressure, value: 5}\n  - pause: 2s\n")
    assert result.verdict is Verdict.INCONCLUSIVE
    assert "ctd.pressure takes effect: no effect" in result.reason


@pytest.mark.parametrize(("tag", "value", "effect"), [("serial", 5, False), ("slope_long", 5, True)])
def test_an_object_takes_effect_when_the_node_has_sent_it(tmp_path: Path, tag: str, value: int, effect: bool) -> None:
    """Defect: a serial number, which the gateway reads once at the start, was set in the middle of a scenario that passed."""
    steps = (
        "  - wait: {until: \"quality(inclinometer.slope_long) == 'good'\", within: 5s}\n"
        f"  - set: {{tag: inclinometer.{tag}, value: {value}}}\n"
        "  - pause: 5s\n"
        "  - expect: {that: \"quality(inclinometer.slope_long) == 'good'\"}\n"
    )
    result = run(tmp_path, "observatory", steps)
    assert result.verdict is (Verdict.PASSED if effect else Verdict.INCONCLUSIVE), result.reason
    assert (f"inclinometer.{tag} takes effect: no effect" in result.reason) is not effect
