"""A deadline is extended by the measured lateness of the host, and by no more.

Defect: on a loaded host one of three scenarios with `--target local` was INCONCLUSIVE, so that CI could not use it.
"""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from click.testing import CliRunner
from late_host_rig import HEAD, judged_on

from fieldtwin.cli.test import test_command
from fieldtwin.reports.junit import render_junit
from fieldtwin.reports.run.html import render_html
from fieldtwin.results.model import Report, ScenarioResult, Verdict
from fieldtwin.run.benches.host_lateness import HostLateness
from fieldtwin.run.benches.virtual_bench import VirtualBench
from fieldtwin.run.targets import scenario_targets
from fieldtwin.run.targets.scenario_targets import ScenarioTarget, run_scenario
from fieldtwin.scenarios.bench import Can
from fieldtwin.scenarios.language.form import load_scenario

REACTS = "steps:\n  - pause: 1s\n  - send: {period_s: 1}\n  - expect: {that: \"relay.state == 'ACTIVE'\", within: %s}\n"


def judge(folder: Path, text: str, own_s: float, any_s: float, target: str = "local") -> ScenarioResult:
    """Return the verdict on a host with this lateness, in virtual time, where the system is always equally fast."""

    class LateBench(VirtualBench):
        can = VirtualBench.can - {Can.EXACT_TIME}

        def host_late_total_s(self, since_s: float) -> tuple[float, float]:
            return own_s, any_s

    LateBench.target = target
    return judged_on(LateBench, folder, text)


@pytest.fixture(scope="module")
def takes_s(tmp_path_factory: pytest.TempPathFactory) -> float:
    """Return how long the system takes to react to a command, in seconds of virtual time."""
    check = judge(tmp_path_factory.mktemp("takes"), REACTS % "30s", 0, 0).checks[-1]
    assert check.verdict is Verdict.PASSED
    assert check.t_ns is not None
    assert check.since_ns is not None
    return (check.t_ns - check.since_ns) / 1e9


def test_a_miss_by_less_than_the_lateness_passes_with_a_note(tmp_path: Path, takes_s: float) -> None:
    result = judge(tmp_path, REACTS % f"{takes_s * 0.6:.3f}s", takes_s * 0.8, takes_s * 0.8)
    assert result.verdict is Verdict.PASSED, result.checks
    assert "this host itself was late for" in result.checks[-1].reason
    assert "subtracted" in result.checks[-1].reason


def test_a_miss_by_more_than_the_lateness_fails(tmp_path: Path, takes_s: float) -> None:
    result = judge(tmp_path, REACTS % f"{takes_s * 0.4:.3f}s", takes_s * 0.2, takes_s * 0.2)
    assert result.verdict is Verdict.FAILED, result.checks
    assert "also not in" in result.checks[-1].got


def test_lateness_that_may_be_the_system_s_own_never_passes(tmp_path: Path, takes_s: float) -> None:
    """A blocked gateway answers late, and that does not count as lateness of the host."""
    result = judge(tmp_path, REACTS % f"{takes_s * 0.6:.3f}s", 0, takes_s * 0.8)
    assert result.verdict is Verdict.INCONCLUSIVE, result.checks
    assert "the host or the system may be the cause" in result.checks[-1].got


def test_an_event_that_never_occurs_fails_however_late_the_host_was(tmp_path: Path) -> None:
    result = judge(tmp_path, "steps:\n  - wait: {until: \"relay.state == 'OFF'\", within: 2s}\n", 1.5, 1.5)
    assert result.verdict is Verdict.FAILED, result.checks
    assert result.simulated_s == pytest.approx(3.5, abs=0.1)


def test_a_host_that_was_later_than_the_budget_proves_nothing(tmp_path: Path) -> None:
    result = judge(tmp_path, "steps:\n  - wait: {until: \"relay.state == 'OFF'\", within: 1s}\n", 60, 60)
    assert result.verdict is Verdict.INCONCLUSIVE, result.checks
    assert result.simulated_s < 4, "the time budget is twice the time of the check"


def test_a_plant_and_a_time_in_the_expression_get_nothing(tmp_path: Path, takes_s: float) -> None:
    text = REACTS % f"{takes_s * 0.6:.3f}s"
    steps = text.replace("send: {period_s: 1}", "pause: 1ms")
    assert judge(tmp_path, steps, 9, 9, target="real").verdict is not Verdict.PASSED
    aged = "steps:\n  - wait: {until: \"relay.state == 'OFF' and age(ctd.status) < 2 s\", within: 1s}\n"
    result = judge(tmp_path, aged, 0.5, 0.5)
    assert result.verdict is Verdict.FAILED
    assert result.simulated_s == pytest.approx(1, abs=0.1), "not prolonged"


def test_a_rule_of_the_whole_run_is_prolonged_too(tmp_path: Path, takes_s: float) -> None:
    rule = 'within: [{after: "command pending", then: "relay.state == \'ACTIVE\'", within: %.3fs}]\n'
    steps = "steps:\n  - pause: 1s\n  - send: {period_s: 1}\n  - pause: 10s\n"
    late = takes_s * 0.8
    assert judge(tmp_path, rule % (takes_s * 0.6) + steps, late, late).verdict is Verdict.PASSED
    assert judge(tmp_path, rule % (takes_s * 0.6) + steps, 0, late).verdict is Verdict.INCONCLUSIVE
    assert judge(tmp_path, rule % (takes_s * 0.3) + steps, takes_s * 0.1, takes_s * 0.1).verdict is Verdict.FAILED


def test_only_lateness_after_the_start_counts() -> None:
    late = HostLateness()
    late.slept(1.0, 0.004)  # lateness of sleeps
    late.slept(2.0, 0.505)
    late.slept(5.0, 1.005)
    late.waited(6.0, 2.0)
    assert late.own_s(0) == pytest.approx(1.5)
    assert late.own_s(1.8) == pytest.approx(1.2), "0.3 s of the first delay lay before"
    assert late.own_s(5.5) == 0
    assert late.any_s(0) == 2
    assert late.longest_s(0) == 2


def attempts_of(monkeypatch: pytest.MonkeyPatch, verdicts: list[Verdict]) -> list[Verdict]:
    """Let attempts end with these verdicts; the number of remaining verdicts shows how many attempts were made."""
    left = list(verdicts)

    def attempt(scenario: object, target: object, trace_file: object, progress: object) -> ScenarioResult:
        verdict = left.pop(0)
        return ScenarioResult("a test", verdict, reason="step 1: too late" if verdict is Verdict.INCONCLUSIVE else "")

    monkeypatch.setattr(scenario_targets, "_attempt", attempt)
    return left


INCONCLUSIVE, PASSED, FAILED = Verdict.INCONCLUSIVE, Verdict.PASSED, Verdict.FAILED


@pytest.mark.parametrize(
    ("ends", "retries", "target", "verdict", "attempts"),
    [
        ([INCONCLUSIVE, INCONCLUSIVE, PASSED], 3, "local", PASSED, 3),
        ([INCONCLUSIVE, FAILED, PASSED], 3, "local", FAILED, 2),
        ([FAILED, PASSED], 3, "local", FAILED, 1),
        ([INCONCLUSIVE, INCONCLUSIVE, INCONCLUSIVE, PASSED], 2, "compose", INCONCLUSIVE, 3),
        ([INCONCLUSIVE, PASSED], 0, "local", INCONCLUSIVE, 1),
        ([INCONCLUSIVE, PASSED], 3, "virtual", INCONCLUSIVE, 1),
    ],
)
def test_only_inconclusive_attempts_are_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends: list[Verdict], retries: int, target: str, verdict: Verdict,
    attempts: int,
) -> None:  # fmt: skip
    path = tmp_path / "x.scenario.yaml"
    path.write_text(HEAD + "steps:\n  - pause: 1s\n")
    left = attempts_of(monkeypatch, ends)
    result = run_scenario(load_scenario(path), ScenarioTarget(target), retries=retries)
    assert result.verdict is verdict
    assert result.attempts == attempts == len(ends) - len(left)
    assert result.earlier == ("step 1: too late",) * (attempts - 1)


def test_retries_are_reported_in_text_json_junit_and_html(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.scenario.yaml"
    path.write_text(HEAD + "steps:\n  - pause: 1s\n")
    words = [str(path), "--target", "local", "--retry-inconclusive", "3"]
    attempts_of(monkeypatch, [INCONCLUSIVE, PASSED])
    shown = CliRunner().invoke(test_command.command, words, standalone_mode=False)
    assert "attempt 1 of 2 was inconclusive: step 1: too late" in shown.output
    attempts_of(monkeypatch, [INCONCLUSIVE, PASSED])
    plain = CliRunner().invoke(test_command.command, [*words, "--json"], standalone_mode=False)
    (result,) = json.loads(plain.stdout)
    assert (result["attempts"], result["inconclusive_attempts"]) == (2, ["step 1: too late"])
    told = ScenarioResult("a test", PASSED, earlier=("step 1: too late",))
    found = {
        one.get("name"): one.get("value") for one in ET.fromstring(render_junit(Report("r", [told]))).iter("property")
    }
    assert found["attempts"] == "2"
    assert found["inconclusive attempt"] == "step 1: too late"
    attempts_of(monkeypatch, [INCONCLUSIVE, PASSED])
    CliRunner().invoke(test_command.command, [*words, "--html", str(tmp_path / "r.html")], standalone_mode=False)
    assert (tmp_path / "r.html").read_text().count("attempt 1 of 2 was inconclusive: step 1: too late") == 1
    failed = ScenarioResult("a test", FAILED, earlier=("step <1>: too late",))
    page = render_html(Report("r", [failed]))
    # in the table, and at the failed step
    assert page.count("attempt 1 of 2 was inconclusive: step &lt;1&gt;: too late") == 2


def test_writes_to_a_plant_are_not_repeated(tmp_path: Path) -> None:
    path = tmp_path / "x.scenario.yaml"
    path.write_text(HEAD + "steps:\n  - pause: 1s\n")
    words = [str(path), "--target", "real", "--allow", "write", "--retry-inconclusive", "3"]
    ended = CliRunner().invoke(test_command.command, words, standalone_mode=False)
    assert "would repeat a scenario's writes to a plant" in str(ended.exception)
