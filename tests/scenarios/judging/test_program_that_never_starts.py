"""A scenario whose program never started: nothing of the program was tested, so the scenario must not pass."""

from __future__ import annotations

from pathlib import Path

import pytest
from fan_hall import hall

from fieldtwin.results.model import Verdict
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.scenarios.language.form import load_scenario

STEPS = """
scenario: a sensor that is out of its range from the start
system: hall.yaml
steps:
  - pause: 1s
  - expect: {that: "fan.mode == 2", during: %s}
"""


@pytest.mark.parametrize(("during", "told"), [("3s", "waits for sensor.temperature"), ("30s", "has not started")])
def test_it_fails_before_and_after_the_timeout(tmp_path: Path, during: str, told: str) -> None:
    hall(tmp_path)
    profile = tmp_path / "thermometer.yaml"
    profile.write_text(profile.read_text().replace("unit: degC", "unit: degC, range: [0, 10]"))  # the sensor reads 21.6
    file = tmp_path / "silent.scenario.yaml"
    file.write_text(STEPS % during)
    result = run_virtual(load_scenario(file, []))
    assert result.verdict is Verdict.FAILED
    assert told in result.reason
