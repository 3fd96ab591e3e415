"""``like: recording`` compares a tag with the value of its device when the tag was read, even if the device held it long
before.

Defect, on a loaded host with ``--target local``: "4.58; the device holds 4.92" made a scenario FAILED although the device had
held 4.58 when it was read. That value was sampled just before the examined time, and a newer one followed.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.results.model import Verdict
from fieldtwin.run.targets.scenario_targets import ScenarioTarget, run_scenario
from fieldtwin.scenarios.judging.expectation import held_since
from fieldtwin.scenarios.language.form import load_scenario

HELD = [(1.0, b"a"), (2.0, b"b"), (3.0, b"c")]


@pytest.mark.parametrize(
    ("since_s", "expected"),
    [(0.5, b"abc"), (1.0, b"abc"), (1.9, b"abc"), (2.0, b"bc"), (2.5, b"bc"), (3.5, b"c")],
)
def test_a_value_is_held_until_the_next_one_begins(since_s: float, expected: bytes) -> None:
    assert b"".join(held_since(HELD, since_s)) == expected
    assert held_since([], since_s) == []


SCENARIO = """scenario: the tag is what the device holds
system: observatory
seed: SEED
steps:
  - send: {period_s: 1}
  - wait: {until: "quality(ctd.pressure) == 'good'", within: 15s}
  - FAULT
  - expect: {tag: ctd.pressure, like: recording, tolerance: 0.001, during: 20s}
"""


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("by_ms", [0, 200])
def test_a_sampling_sensor_equals_its_held_value_at_any_delay(tmp_path: Path, seed: int, by_ms: int) -> None:
    path = tmp_path / "x.scenario.yaml"
    fault = f"fault: {{name: delay, device: ctd, by_ms: {by_ms}.0}}" if by_ms else "pause: 1s"
    path.write_text(SCENARIO.replace("SEED", str(seed)).replace("FAULT", fault))
    result = run_scenario(load_scenario(path), ScenarioTarget())
    assert result.verdict is Verdict.PASSED, result.checks[-1]
