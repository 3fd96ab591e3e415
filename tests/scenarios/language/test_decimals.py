"""A 32-bit float counts in scenarios as the shortest decimal number that it stands for."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.conditions.decimals import as_decimal
from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.scenarios.language.form import load_scenario

TANK = """
device: mysite/tank
protocol: modbus
source: invented
tags:
  level: {at: 30001, type: float32, unit: m}
"""
SYSTEM = """
fieldtwin: 1
system: hall
buses: {lan: {url: "tcp://192.0.2.1:502"}}
devices: {tank: {profile: ./tank.yaml, bus: lan, unit: 1, poll: {values: {every_ms: 100}}}}
"""
PROTOTYPE = """
prototype_of: hall.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices: {tank: {model: profile, values: {level: 2.3}}}
"""


def single(value: float) -> float:
    rounded: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return rounded


@pytest.mark.parametrize("value", [2.3, 0.1, 1e-3, 101.325, 16777216.0, -0.7, 1e-45])
def test_a_32_bit_float_is_shown_as_it_was_written(value: float) -> None:
    assert as_decimal(single(value)) == value


@pytest.mark.parametrize("value", [2.3, 1 / 3, 1e300, True, 7, None, "OPEN", b"x", float("inf")])
def test_every_other_value_is_unchanged(value: Any) -> None:
    assert as_decimal(value) is value or as_decimal(value) == value


@given(st.floats(allow_nan=False, width=32))
def test_the_decimal_stands_for_the_same_float_and_has_at_most_9_digits(value: float) -> None:
    found = as_decimal(value)
    assert single(found) == value
    assert value.is_integer() or float(f"{found:.9g}") == found


@given(st.floats(allow_nan=False))
def test_no_double_is_changed_by_more_than_half_a_32_bit_step(value: float) -> None:
    found = as_decimal(value)
    assert found == value or single(found) == value


def run(folder: Path, expected: str) -> ScenarioResult:
    (folder / "tank.yaml").write_text(TANK)
    (folder / "hall.yaml").write_text(SYSTEM)
    (folder / "hall.prototype.yaml").write_text(PROTOTYPE)
    path = folder / "x.scenario.yaml"
    path.write_text(f"scenario: a tank\nsystem: hall.yaml\nsteps:\n  - pause: 1s\n  - expect: {expected}\n")
    return run_virtual(load_scenario(path))


@pytest.mark.parametrize(
    "expected",
    [
        "{tag: tank.level, value: 2.3}",
        '{that: "tank.level == 2.3"}',
        '{that: "tank.level >= 2.3 and value(tank.level) <= 2.3"}',
    ],
)
def test_a_scenario_compares_the_number_that_the_device_stands_for(tmp_path: Path, expected: str) -> None:
    result = run(tmp_path, expected)
    assert result.verdict is Verdict.PASSED, result.checks


@pytest.mark.parametrize("expected", ["{tag: tank.level, value: 2.5}", '{that: "tank.level > 2.5"}'])
def test_a_failure_shows_the_number_that_the_device_stands_for(tmp_path: Path, expected: str) -> None:
    result = run(tmp_path, expected)
    assert result.verdict is Verdict.FAILED
    shown = " ".join(f"{check.got} {check.expected}" for check in result.checks)
    assert "2.3" in shown
    assert "2.29999" not in shown + result.reason + " ".join(result.evidence)
