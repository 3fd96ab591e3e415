"""Scenarios and invariants accept the names in the `values` of a tag in place of numbers, and refuse every other text."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.scenarios.language.form import load_scenario

DRIVE = """
device: mysite/drive
protocol: modbus
source: invented
tags:
  state: {at: 30001, type: uint16, values: {0: "OK", 1: "TRIPPED"}}
  current: {at: 30002, type: uint16}
  text: {at: 30010, type: string, registers: 2}
"""
SYSTEM = """
fieldtwin: 1
system: hall
buses: {lan: {url: "tcp://192.0.2.1:502"}}
devices:
  drive: {profile: ./drive.yaml, bus: lan, unit: 1, poll: {values: {every_ms: 100}}}
invariants:
  never: ["drive.state == 'TRIPPED' and drive.current > 5"]
"""
PROTOTYPE = """
prototype_of: hall.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices: {drive: {model: profile, values: {state: OK}}}
"""


def scenario(folder: Path, steps: str) -> Path:
    (folder / "drive.yaml").write_text(DRIVE)
    (folder / "hall.yaml").write_text(SYSTEM)
    (folder / "hall.prototype.yaml").write_text(PROTOTYPE)
    path = folder / "x.scenario.yaml"
    path.write_text(f"scenario: a drive\nsystem: hall.yaml\nsteps:\n{steps}")
    return path


def run(folder: Path, steps: str) -> ScenarioResult:
    return run_virtual(load_scenario(scenario(folder, steps)))


TRIP = "  - wait: {until: \"drive.state == 'OK'\", within: 2s}\n  - set: {tag: drive.state, value: TRIPPED}\n"


def test_a_name_is_set_and_compared_like_its_number(tmp_path: Path) -> None:
    result = run(
        tmp_path,
        TRIP
        + "  - expect: {tag: drive.state, value: TRIPPED, within: 1s}\n"
        + "  - expect: {tag: drive.state, value: 1}\n"
        + "  - expect: {that: \"'TRIPPED' == drive.state and value(drive.state) != 'OK'\"}\n",
    )
    assert result.verdict is Verdict.PASSED, result.checks


def test_a_name_in_an_expectation_can_fail(tmp_path: Path) -> None:
    for check in ("{tag: drive.state, value: OK}", "{that: \"drive.state == 'OK'\"}"):
        result = run(tmp_path, TRIP + f"  - pause: 1s\n  - expect: {check}\n")
        assert result.verdict is Verdict.FAILED, check


def test_a_name_in_an_invariant_is_compared_with_the_value(tmp_path: Path) -> None:
    result = run(tmp_path, TRIP + "  - set: {tag: drive.current, value: 6}\n  - pause: 1s\n")
    assert result.verdict is Verdict.FAILED
    assert "invariant never 1" in result.reason


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (
            "expect: {that: \"drive.state == 'TRIPED'\"}",
            "never 'TRIPED'; expected OK, TRIPPED (did you mean 'TRIPPED'?)",
        ),
        ("expect: {that: \"drive.current > 'high'\"}", "drive.current is a number, and 'high' is a text"),
        ("expect: {tag: drive.state, value: TRIPED}", "did you mean 'TRIPPED'"),
        ("expect: {tag: drive.current, value: high}", "drive.current is a number; got 'high'"),
        ("expect: {wire: drive, register: state, value: TRIPPED}", "drive.state is a number; got 'TRIPPED'"),
        (
            "set: {tag: drive.state, value: TRIPED}",
            "a number; expected OK, TRIPPED; got 'TRIPED' (did you mean 'TRIPPED'?)",
        ),
    ],
)
def test_a_text_that_a_number_never_equals_is_refused(tmp_path: Path, step: str, message: str) -> None:
    with pytest.raises(FileInvalid) as e:
        load_scenario(scenario(tmp_path, f"  - {step}\n"))
    assert message in str(e.value)
    assert e.value.line == 4


def test_a_text_tag_is_compared_with_any_text(tmp_path: Path) -> None:
    load_scenario(scenario(tmp_path, "  - expect: {that: \"drive.text == 'AB'\"}\n"))
