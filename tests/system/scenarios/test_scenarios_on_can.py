"""Scenarios on a given CAN interface: `fieldtwin test --target local --can`."""

from __future__ import annotations

from pathlib import Path

import pytest
from procs import free_port

from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.run.targets.scenario_targets import ScenarioTarget, run_scenario
from fieldtwin.scenarios.language.form import load_scenario

SCENARIO = """
scenario: a node is read
system: observatory
steps:
  - wait: {until: "quality(inclinometer.slope_long) == 'good'", within: 120s}
  - set: {tag: inclinometer.slope_long, value: 4.5}
  - wait: {until: "inclinometer.slope_long == 4.5", within: 60s}
"""


def judged(folder: Path, where: str) -> ScenarioResult:
    path = folder / "x.scenario.yaml"
    path.write_text(SCENARIO)
    return run_scenario(load_scenario(path), ScenarioTarget("local", can=where))


@pytest.mark.long
def test_the_bus_is_at_the_given_endpoint(tmp_path: Path) -> None:
    where = f"fieldtwin/127.0.0.1:{free_port()}"
    result = judged(tmp_path, where)
    assert result.verdict is Verdict.PASSED, (result.reason, result.checks)
    assert f"--can {where}" in result.reproduce


def test_a_kernel_without_the_interface_is_an_error_and_nothing_takes_its_place(tmp_path: Path) -> None:
    result = judged(tmp_path, "socketcan/nocan7")
    assert result.verdict is Verdict.ERROR
    assert "nocan7" in result.reason


def test_a_network_has_no_bus_of_that_name(tmp_path: Path) -> None:
    path = tmp_path / "n.scenario.yaml"
    path.write_text("scenario: still water\nsystem: ocean_network\nsteps:\n  - pause: 1s\n")
    result = run_scenario(load_scenario(path), ScenarioTarget("local", can="socketcan/vcan0"))
    assert result.verdict is Verdict.SKIPPED
    assert "--can" in result.reason
