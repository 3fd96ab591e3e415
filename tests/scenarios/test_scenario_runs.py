"""Scenarios against the observatory in virtual time: passing ones, failing ones with their reasons, and those refused at the
start."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from fieldtwin.cli.test.test_command import command
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.scenarios.language.about import impact_of
from fieldtwin.scenarios.language.form import load_scenario

SHIPPED = sorted((Path(__file__).resolve().parents[2] / "profiles" / "systems").glob("*.scenario.yaml"))


def written(folder: Path, steps: str, head: str = "") -> Path:
    path = folder / "x.scenario.yaml"
    path.write_text(f"scenario: a test\nsystem: observatory\n{head}steps:\n{steps}")
    return path


def run(folder: Path, steps: str, head: str = "") -> ScenarioResult:
    return run_virtual(load_scenario(written(folder, steps, head)))


LONG = ("ocean-front.scenario.yaml", "ocean-loss.scenario.yaml", "ocean-silent.scenario.yaml")


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, id=path.name, marks=[pytest.mark.long] if path.name in LONG else []) for path in SHIPPED],
)
def test_shipped_scenarios_pass_and_give_the_same_trace_again(path: Path) -> None:
    first = run_virtual(load_scenario(path))
    assert first.verdict is Verdict.PASSED, first.checks
    if path.name in ("node-lost.scenario.yaml", "lab_vehicle.scenario.yaml"):
        assert run_virtual(load_scenario(path)).trace_hash == first.trace_hash


ACTIVE = "  - send: {period_s: 1}\n  - wait: {until: \"relay.state == 'ACTIVE'\", within: 10s}\n"


@pytest.mark.parametrize(
    ("steps", "expected", "got"),
    [
        ("  - wait: {until: \"relay.state == 'ACTIVE'\", within: 1s}\n", "within 1 s", "STANDBY"),
        ("  - expect: {tag: relay.state, value: ACTIVE, within: 1s}\n", "ACTIVE", "STANDBY"),
        ("  - pause: 2s\n  - expect: {tag: inclinometer.slope_long, quality: bad}\n", "bad", "good"),
        ("  - expect: {tag: inclinometer.slope_long, updates_per_s: [1, 2], during: 5s}\n", "1 to 2", "9"),
        ("  - expect: {wire: ctd, requests_per_s: {max: 1}, during: 5s}\n", "at most 1", "3"),
        ("  - expect: {wire: ctd, function: 16, times: 3, within: 2s}\n", "3 times", "0: none"),
        (ACTIVE + "  - expect: {wire: ctd, register: sample_period_s, value: 2, within: 1s}\n", "at least 1", "none"),
        (
            "  - pause: 2s\n  - set: {tag: ctd.pressure, value: 1}\n  - expect: {that: 'ctd.pressure == 1', within: 1s}\n",
            "",
            "",
        ),
    ],
)
def test_a_failed_check_shows_the_observed_value(tmp_path: Path, steps: str, expected: str, got: str) -> None:
    result = run(tmp_path, steps)
    assert result.verdict is Verdict.FAILED
    (failed,) = (check for check in result.checks if check.verdict is Verdict.FAILED)
    assert expected in failed.expected
    assert got in failed.got
    assert failed.names, "a report shows first what the check was about"
    assert all(name in steps.splitlines()[-1] for name in failed.names)
    assert failed.where == f"{tmp_path / 'x.scenario.yaml'}:{3 + int(failed.number)}"
    assert result.reproduce.startswith("fieldtwin test ")


def test_a_set_value_takes_effect_and_ends(tmp_path: Path) -> None:
    steps = ACTIVE + (
        "  - set: {tag: ctd.temperature, value: 99.5}\n"
        "  - expect: {tag: ctd.temperature, value: 99.5, tolerance: 0.01, quality: good, within: 4s}\n"
        "  - set: {tag: ctd.temperature, value: null}\n"
        "  - expect: {tag: ctd.temperature, like: recording, tolerance: 0.01, within: 4s}\n"
        "  - expect: {that: 'ctd.temperature < 90', within: 4s, during: 2s}\n"
    )
    result = run(tmp_path, steps)
    assert result.verdict is Verdict.PASSED, result.checks[-1]


def test_always_and_never_are_checked_all_the_time(tmp_path: Path) -> None:
    always = run(tmp_path, ACTIVE, "always: [\"relay.state == 'STANDBY'\"]\n")
    assert (always.verdict, always.checks[-1].number) == (Verdict.FAILED, "always 1")
    assert "ACTIVE" in always.checks[-1].got
    never = run(
        tmp_path, ACTIVE + "  - pause: 2s\n", "never: [{wire: ctd, access: write, register: sample_period_s}]\n"
    )
    assert never.verdict is Verdict.FAILED
    assert "sample_period_s" in never.checks[-1].got


def test_duration_checks_must_last_and_invariants_hold_at_once(tmp_path: Path) -> None:
    good = "  - wait: {until: \"quality(inclinometer.slope_long) == 'good'\"}\n"
    dead = good + "  - fault: {name: lost-frame, device: inclinometer}\n"
    lasting = run(tmp_path, dead + "  - expect: {tag: inclinometer.slope_long, quality: good, during: 10s}\n")
    assert lasting.verdict is Verdict.FAILED
    assert "bad" in lasting.checks[-1].got
    at_once = run(tmp_path, "  - pause: 100ms\n  - send: {period_s: 1}\n", "always: [\"relay.state == 'OFF'\"]\n")
    assert at_once.verdict is Verdict.FAILED
    never_known = run(tmp_path, "  - pause: 2s\n", "always: ['ctd.pressure > 0']\n")  # it is in standby
    assert never_known.verdict is Verdict.INCONCLUSIVE
    with pytest.raises(FileInvalid, match="no tag of ctd 'nothere'"):
        run(tmp_path, "  - pause: 1s\n", "never: [{wire: ctd, register: nothere}]\n")


def test_an_unsupported_step_of_a_target_is_skipped_and_does_not_pass(tmp_path: Path) -> None:
    result = run(tmp_path, "  - pause: 1s\n", "needs: [probe]\n")
    assert result.verdict is Verdict.SKIPPED
    assert "probe" in result.reason
    ended = CliRunner().invoke(command, [str(tmp_path / "x.scenario.yaml"), "--json"], standalone_mode=False)
    assert ended.return_value == 1
    assert json.loads(ended.output)[0]["verdict"] == "skipped"


@pytest.mark.parametrize(
    ("steps", "told", "line"),
    [
        ("  - snd: {period_s: 1}\n", "did you mean 'send'", 4),
        ("  - send: {period_s: 1}\n    pause: 1s\n", "exactly one key", 4),
        ("  - fault: {name: silense, device: ctd}\n", "did you mean 'silence'", 4),
        ("  - fault: {name: silence, device: ctb}\n", "did you mean 'ctd'", 4),
        ("  - fault: {name: bus-off, device: ctd}\n", "for CAN buses", 4),
        ("  - fault: {id: dead, name: silence, device: ctd}\n  - clear: daed\n", "did you mean 'dead'", 5),
        ("  - clear: dead\n", "no fault of an earlier step 'dead'", 4),
        ("  - expect: {tag: ctd.presure, quality: good}\n", "did you mean 'ctd.pressure'", 4),
        ("  - expect: {wire: ctd, register: pressur, times: 1}\n", "did you mean 'pressure'", 4),
        ("  - pause: 1s\n  - wait: {until: 'relay.stat == 1'}\n", "did you mean 'relay.state'", 5),
        ("  - pause: soon\n", "a time", 4),
        ("  - expect: {quality: good}\n", "exactly one of tag, wire and that", 4),
        ("  - expect: {tag: ctd.pressure, times: 1}\n", "'times' has no meaning for this expectation", 4),
        ("  - expect: {wire: ctd, quality: good}\n", "'quality' has no meaning for this expectation", 4),
        ("  - expect: {wire: ctd, requests_per_s: {max: 1}}\n", "during: 10s", 4),
        ("  - expect: {tag: ctd.pressure, quality: goood}\n", "did you mean 'good'", 4),
        ("  - expect: {tag: relay.state, like: recording}\n", "DEVICE.TAG", 4),
        ("  - expect: {tag: ctd.pressure, like: recordng}\n", "did you mean 'recording'", 4),
        ("  - expect: {wire: ctd, access: wirte}\n", "expected read or write; got 'wirte' (did you mean 'write'", 4),
        ("  - expect: {tag: relay.state, value: ACTVE}\n", "did you mean 'ACTIVE'", 4),
        ("  - set: {tag: ctd.pressure, value: high}\n", "ctd.pressure is a number; got 'high'", 4),
        ("  []\n", "steps is empty", 3),
        ("  - {clear: dead, wait: 3s}\n", "exactly one key; expected send or set", 4),
        ("  - expect: {tag: ctd.pressure, value: 1, tolerance: -1}\n", "tolerance", 4),
        ("  - expect: {wire: ctd, requests_per_s: {max: 2}, during: 0s}\n", "time above 0", 4),
        ("  - expect: {wire: ctd, requests_per_s: {}, during: 5s}\n", "always met", 4),
        ("  - expect: {wire: ctd, times: {min: 0}}\n", "always met", 4),
        ("  - expect: {wire: ctd, times: {max: -1}}\n", "never negative", 4),
        ("  - expect: {wire: ctd, times: {min: 3, max: 1}}\n", "these bounds can never be met", 4),
        ("  - expect: {tag: ctd.pressure, updates_per_s: [11, 9], during: 5s}\n", "a rate needs bounds", 4),
        ("  - expect: {tag: ctd.pressure, updates_per_s: [9], during: 5s}\n", "a rate needs bounds", 4),
        ("  - expect: {wire: ctd, value: 7, times: 0}\n", "register of the value is missing", 4),
        ("  - expect: {that: '1 < 2'}\n", "refers to no value", 4),
        ("  - wait: {until: '1'}\n", "refers to no value", 4),
    ],
)
def test_a_mistake_is_named_at_its_position(tmp_path: Path, steps: str, told: str, line: int) -> None:
    with pytest.raises(FileInvalid) as e:
        load_scenario(written(tmp_path, steps))
    assert told in str(e.value)
    assert e.value.line == line


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("system: observatry\n", "no system 'observatry'; expected a file, or one of "),
        ("system: observatory\nprototype: x.prototyp.yaml\n", "did you mean 'x.prototype.yaml'"),
    ],
)
def test_a_missing_file_is_named_at_its_reference(tmp_path: Path, line: str, told: str) -> None:
    (tmp_path / "x.prototype.yaml").touch()
    path = tmp_path / "x.scenario.yaml"
    path.write_text(f"scenario: a test\n{line}steps:\n  - pause: 1s\n")
    with pytest.raises(FileInvalid) as e:
        load_scenario(path)
    assert told in str(e.value)
    assert e.value.line == line.count("\n") + 1


def test_a_scenario_without_expectations_does_not_pass(tmp_path: Path) -> None:
    result = run(tmp_path, "  - send: {period_s: 1}\n  - pause: 1s\n")
    assert result.verdict is Verdict.INCONCLUSIVE
    assert "has no expectation" in result.reason


BITS = "  - fault: {id: bits, name: corrupt-bits, device: modem, function: 3, from: 1s, until: 3s}\n"
"""These faults cannot be detected: Modbus TCP has no checksum."""


@pytest.mark.parametrize(("steps", "verdict"), [("", Verdict.PASSED), (BITS, Verdict.FAILED)])
def test_a_scenario_can_be_checked_like_a_run(tmp_path: Path, steps: str, verdict: Verdict) -> None:
    result = run(tmp_path, f"{steps}  - send: {{period_s: 1}}\n  - pause: 12s\n", "judge: run\n")
    assert result.verdict is verdict, result.reason
    check = result.checks[-1]
    assert (check.number, check.verdict, check.where) == ("judge", verdict, f"{tmp_path / 'x.scenario.yaml'}:3")
    if verdict is Verdict.FAILED:
        assert "never occurred in their device" in result.reason
        assert "modem." in check.got


def test_an_invalid_time_is_named_at_its_position(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="a time") as e:
        load_scenario(written(tmp_path, "  - expect: {tag: ctd.pressure, quality: bad, within: 3 sec}\n"))
    assert (e.value.line, e.value.column) == (4, 47)


def test_reports_are_written(tmp_path: Path) -> None:
    path = written(tmp_path, ACTIVE, "requirements: [REQ-1]\n")
    words = [str(path), "--html", str(tmp_path / "r.html"), "--junit", str(tmp_path / "r.xml"), "--json"]
    ended = CliRunner().invoke(command, words, standalone_mode=False)
    assert ended.return_value == 0, ended.output
    assert "a test" in (tmp_path / "r.xml").read_text()
    page = (tmp_path / "r.html").read_text()
    assert "Transitions of relay.state" in page
    assert "1 of 6 taken" in page, "what was not is missing: STANDBY to ACTIVE was all"
    (told,) = json.loads(ended.output)
    assert (told["verdict"], told["requirements"]) == ("passed", ["REQ-1"])
    about = {"case": "x", "role": "controller", "impact": "write"}  # ACTIVE sends
    assert {name: told[name] for name in about} == about
    for name, value in {**about, "requirement": "REQ-1"}.items():
        assert f'<property name="{name}" value="{value}" />' in (tmp_path / "r.xml").read_text()
        assert f"<td>{value}</td>" in (tmp_path / "r.html").read_text()


@pytest.mark.parametrize(
    ("steps", "impact"),
    [
        ("  - pause: 1s\n", "observe"),
        ("  - set: {tag: ctd.pressure, value: 5}\n  - pause: 1s\n", "write"),
        ("  - send: {period_s: 1}\n  - fault: {id: f, name: silence, device: ctd}\n", "disrupt"),
    ],
)
def test_a_scenario_has_the_impact_of_its_worst_step(tmp_path: Path, steps: str, impact: str) -> None:
    assert impact_of(load_scenario(written(tmp_path, steps))).value == impact
