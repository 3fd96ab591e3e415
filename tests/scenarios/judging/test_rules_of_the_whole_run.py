"""Rules of a scenario for the whole run, and probes, in virtual time: rules that hold, and broken ones with time and reason."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.scenarios.language.form import load_scenario

ACTIVE = "  - send: {period_s: 1}\n  - wait: {until: \"quality(ctd.pressure) == 'good'\", within: 15s}\n"
SILENT_AT_ONCE = "  - fault: {name: silence, device: ctd}\n  - pause: 1ms\n"
"""The first exchange is not over when the scenario ends."""
SILENT = ACTIVE + "  - fault: {id: dead, name: silence, device: ctd}\n  - pause: 5s\n"
HMI = """probes:
  desk:
    serve: hmi
    every: 100ms
    registers:
      pressure: {at: 30001, type: float32}
      temperature: {at: 30005, type: float32}
"""


def run(folder: Path, steps: str, head: str) -> ScenarioResult:
    path = folder / "x.scenario.yaml"
    path.write_text(f"scenario: a test\nsystem: observatory\n{head}steps:\n{steps}")
    return run_virtual(load_scenario(path))


@pytest.mark.parametrize(
    ("head", "steps", "verdict", "told"),
    [
        (
            "within: [{after: \"relay.state == 'ACTIVE'\", then: \"ctd.sample_period_s == 1\", within: 3s}]\n",
            ACTIVE,
            Verdict.PASSED,
            "1 times",
        ),
        (
            "within: [{after: \"relay.state == 'ACTIVE'\", then: \"ctd.sample_period_s == 9\", within: 2s}]\n",
            "  - send: {period_s: 1}\n  - wait: {until: \"relay.state == 'ACTIVE'\", within: 10s}\n",
            Verdict.FAILED,
            "did not hold until 2.3",
        ),
        (
            "rate: [{tag: inclinometer.slope_long, updates_per_s: {min: 9, max: 11}, over: 2s, "
            "while: \"quality(inclinometer.slope_long) == 'good'\"}]\n",
            "  - pause: 6s\n",
            Verdict.PASSED,
            "looks",
        ),
        ("rate: [{tag: ctd.pressure, updates_per_s: {min: 0.5}, over: 3s}]\n", "  - pause: 6s\n", Verdict.FAILED, "0/s"),
        ("rate: [{wire: ctd, requests_per_s: {max: 10}, over: 2s}]\n", SILENT, Verdict.PASSED, "looks"),
        ("rate: [{wire: ctd, requests_per_s: {max: 1}, over: 2s}]\n", SILENT, Verdict.FAILED, "/s:"),
        ("rate: [{wire: ctd, requests_per_s: {max: 1}, over: 1h}]\n", "  - pause: 2s\n", Verdict.INCONCLUSIVE, "0 checks"),
        ("cycle: [{changes_of: ctd.sample_count, min: 0.8s, max: 1.7s}]\n", ACTIVE + "  - pause: 4s\n", Verdict.PASSED, ""),
        ("cycle: [{changes_of: ctd.sample_count, max: 1.7s}]\n", SILENT, Verdict.FAILED, "none from"),
        ("cycle: [{changes_of: ctd.sample_count, min: 3s}]\n", ACTIVE + "  - pause: 4s\n", Verdict.FAILED, " s, from"),
        ("cycle: [{late: 1ms}]\n", "  - pause: 1s\n", Verdict.PASSED, "looks"),
        ("never: ['ctd.pressure > 1000']\n", "  - pause: 100ms\n", Verdict.INCONCLUSIVE, ""),
        ("never: ['inclinometer.slope_long > 1000']\n", "  - pause: 2s\n", Verdict.PASSED, ""),
        ("never: [{wire: ctd, access: write}]\n", SILENT_AT_ONCE, Verdict.INCONCLUSIVE, ""),
        ("never: [{wire: ctd, function: 5}]\n", "  - pause: 2s\n", Verdict.PASSED, ""),
        (
            "within: [{after: \"relay.state == 'OFF'\", then: \"quality(ctd.pressure) == 'bad'\", within: 2s}]\n",
            "  - pause: 1s\n",
            Verdict.INCONCLUSIVE,
            "0 times",
        ),
    ],
)  # fmt: skip
def test_the_whole_run_is_checked(tmp_path: Path, head: str, steps: str, verdict: Verdict, told: str) -> None:
    result = run(tmp_path, steps, head)
    assert result.verdict is verdict, result.checks[-1]
    assert told in result.checks[-1].got


def test_probes_see_served_values_under_their_names(tmp_path: Path) -> None:
    steps = ACTIVE + (
        "  - expect: {that: 'desk.pressure == ctd.pressure', within: 3s}\n"
        "  - set: {tag: ctd.temperature, value: 50}\n"
        "  - expect: {tag: desk.temperature, value: 50, tolerance: 0.01, quality: good, within: 5s}\n"
    )
    result = run(tmp_path, steps, HMI + 'always: ["age(desk.pressure) < 1 s"]\n')
    assert result.verdict is Verdict.PASSED, result.checks[-1]
    elsewhere = run(tmp_path, "  - pause: 1s\n", HMI.replace("serve: hmi", 'endpoint: "tcp://127.0.0.1:1"'))
    assert elsewhere.verdict is Verdict.SKIPPED
    assert "cannot probe" in elsewhere.reason


@pytest.mark.parametrize(
    ("head", "told", "line"),
    [
        (HMI.replace("serve: hmi", "serve: hmj"), "no 'hmj'", 5),
        (HMI.replace("float32", "flot32"), "float32", 8),
        (HMI.replace("at: 30001", "att: 30001"), "did you mean 'at'", 8),
        (HMI.replace("desk:", "ctd:"), "device or program", 4),
        (HMI.replace("    serve: hmi\n", ""), "one endpoint", 4),
        (HMI.replace("serve: hmi", 'endpoint: "can:socketcan/can0"'), "uses Modbus", 5),
        (HMI.replace("serve: hmi", 'endpoint: "tpc://127.0.0.1"'), "did you mean 'tcp'", 5),
        ("rate: [{tag: ctd.pressure, requests_per_s: {max: 1}}]\n", "needs a tag or a wire", 3),
        ("cycle: [{changes_of: ctd.pressure}]\n", "bounds", 3),
        ("cycle: [{changes_of: ctd.pressure, min: 2s, max: 1s}]\n", "these bounds can never be met", 3),
        ("rate: [{tag: ctd.pressure, updates_per_s: {}}]\n", "always met", 3),
        ("rate: [{tag: ctd.pressure, updates_per_s: {min: 0}}]\n", "always met", 3),
        ("cycle: [{changes_of: ctd.pressure, min: 0}]\n", "this bound is always met", 3),
        ("always: ['1 == 1']\n", "refers to no value", 3),
        ("never: [{wire: ctd, value: 7}]\n", "register of the value is missing", 3),
        (
            "within: [{after: 'relay.stat == 1', then: 'ctd.pressure > 1', within: 1s}]\n",
            "did you mean 'relay.state'",
            3,
        ),
    ],
)
def test_a_mistake_is_named_at_its_position(tmp_path: Path, head: str, told: str, line: int) -> None:
    with pytest.raises(FileInvalid) as e:
        run(tmp_path, "  - pause: 1s\n", head)
    assert told in str(e.value)
    assert e.value.line == line


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("age(ctd.pressure) <= 2.5 s and ctd.presure > 1", "ctd.presure"),
        ("ctd.pressure > 100 ms or qualty(ctd.pressure) == 'good'", "qualty"),
        ("'5 s' == '5 s' and 10 min > relay.stat", "relay.stat"),
        ("command pending and ctd.pressure // 2 > 1", "ctd.pressure // 2"),
        ("relay.state == 'ACTIVE' or 'ACTVE' == value(relay.state)", "'ACTVE'"),
        ("100 ms > age(ctd.pressure) or quality(ctd.pressure) != 'bade'", "'bade'"),
        ("reason(ctd.pressure) == 'time-out'", "'time-out'"),
    ],
)
def test_an_error_in_an_expression_has_its_own_column(tmp_path: Path, text: str, word: str) -> None:
    with pytest.raises(FileInvalid) as e:
        run(tmp_path, f'  - wait: {{until: "{text}", within: 1s}}\n', "")
    line = (tmp_path / "x.scenario.yaml").read_text().splitlines()[e.value.line - 1]
    assert line[e.value.column - 1 :].startswith(word)
