"""Comparing runs by their meaning, and converting a run into a scenario: with constructed events, and with a virtual run."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.cli.main import cli
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.results.trace import TraceEvent, TraceKind
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.scenarios.language.form import load_scenario
from fieldtwin.scenarios.regression.as_scenario import ScenarioOptions, as_scenario
from fieldtwin.scenarios.regression.comparing import Allowed, RunComparison, compare
from fieldtwin.scenarios.regression.run_history import RunHistory, run_history
from fieldtwin.twin.site.system import load_system

SYSTEM = load_system("observatory")
S = 1_000_000_000


def tag(t_s: float, name: str, value: Any, quality: str = "good") -> TraceEvent:
    return TraceEvent(round(t_s * S), TraceKind.TAG, name, {"value": value, "quality": quality, "reason": "none"})


def state(t_s: float, name: str, value: Any) -> TraceEvent:
    return TraceEvent(round(t_s * S), TraceKind.STATE, name, {"value": value})


def asked(t_s: float, latency_s: float = 0.01, answered: bool = True) -> list[TraceEvent]:
    """The CTD is asked for its period (holding register 40002), and answers 0."""
    request, reply = "010300010001d5ca", "0103020000b844"
    events = [TraceEvent(round(t_s * S), TraceKind.FRAME, "line1", {"dir": "sent", "bytes": request})]
    if answered:
        at_ns = round((t_s + latency_s) * S)
        events.append(TraceEvent(at_ns, TraceKind.FRAME, "line1", {"dir": "received", "bytes": reply}))
    return events


END = [tag(100.0, "modem.link_state", 1)]


def told(events: Iterable[TraceEvent]) -> RunHistory:
    return run_history(SYSTEM, sorted([*events, *END], key=lambda e: e.t_ns))


def judge(old: list[TraceEvent], new: list[TraceEvent], allowed: Allowed | None = None) -> RunComparison:
    return compare(told(old), told(new), allowed)


def kinds(verdict: RunComparison) -> list[tuple[str, str]]:
    return [(d.what, d.where) for d in verdict.differences]


RELAY = [state(1, "relay.state", "STANDBY"), state(10, "relay.state", "ACTIVE"), state(50, "relay.state", "STANDBY")]


def test_irrelevant_times_and_bytes_are_not_a_difference() -> None:
    later = [state(e.t_ns / S + 0.4, e.where, e.data["value"]) for e in RELAY]
    values = [tag(t, "ctd.pressure", 10.0 + t / 1000) for t in range(5, 90, 5)]
    other = [tag(t + 0.7, "ctd.pressure", 10.001 + t / 1000) for t in range(5, 90, 5)]
    verdict = judge(RELAY + values, later + other)
    assert verdict.same
    assert verdict.compared == 3


@pytest.mark.parametrize(
    ("new", "found"),
    [
        ([state(1, "relay.state", "STANDBY"), state(10, "relay.state", "OFF")], [("order", "relay.state")]),
        (RELAY[:2], [("order", "relay.state")]),
        ([*RELAY, state(70, "relay.state", "OFF")], [("order", "relay.state")]),
        ([RELAY[0], state(12, "relay.state", "ACTIVE"), RELAY[2]], [("time", "relay.state")]),
        ([], [("field", "relay.state")]),
    ],
)
def test_states_are_the_same_in_the_same_order_and_in_time(new: list[TraceEvent], found: list[tuple[str, str]]) -> None:
    assert kinds(judge(RELAY, new)) == found


@pytest.mark.parametrize(
    ("new", "found"),
    [
        ([tag(5, "ctd.pressure", 10.5)], "value"),
        ([tag(5, "ctd.pressure", 10.0, "uncertain")], "quality"),
        ([tag(5, "ctd.pressure", 10.0), tag(40, "ctd.pressure", 10.0, "bad")], "quality"),
        ([tag(5, "ctd.pressure", 10.0), tag(40, "ctd.pressure", 11.0), tag(41, "ctd.pressure", 10.0)], "value"),
        ([tag(5, "ctd.pressure", float("nan"))], "value"),
    ],
)
def test_values_and_qualities_are_the_same_all_the_time(new: list[TraceEvent], found: str) -> None:
    assert kinds(judge([tag(5, "ctd.pressure", 10.0)], new)) == [(found, "ctd.pressure")]
    assert kinds(judge(new, [tag(5, "ctd.pressure", 10.0)])) == [(found, "ctd.pressure")]


def test_the_last_value_of_a_bad_tag_does_not_matter() -> None:
    assert judge([tag(5, "ctd.pressure", 10.0, "bad")], [tag(5, "ctd.pressure", None, "bad")]).same


def test_tolerance_window_and_ignored_items() -> None:
    old, new = [tag(5, "ctd.pressure", 10.0)], [tag(8, "ctd.pressure", 10.4)]
    assert not judge(old, new).same
    assert not judge(old, new, Allowed(share=0.05)).same
    assert judge(old, new, Allowed(window_s=4, share=0.05)).same
    assert judge(old, new, Allowed(window_s=4, amounts={"ctd.pressure": 0.5})).same
    assert judge(old, new, Allowed(ignored=frozenset({"ctd"}))).same


def test_only_slower_answers_are_worse() -> None:
    quick = [e for t in range(5, 90, 5) for e in asked(t)]
    slow = [e for t in range(5, 90, 5) for e in asked(t, latency_s=0.05)]
    assert kinds(judge(quick, slow)) == [("latency", "ctd read holding registers")]
    assert judge(slow, quick).same
    assert judge(quick, slow, Allowed(latency_ms=100)).same


def test_requests_without_an_answer_are_new() -> None:
    fine = [e for t in range(5, 90, 5) for e in asked(t)]
    holes = [e for t in range(5, 90, 5) for e in asked(t, answered=t % 10 == 0)]
    assert ("problem", "ctd read holding registers") in kinds(judge(fine, holes))


def test_a_capture_has_values_and_latencies_but_no_states() -> None:
    story = run_history(SYSTEM, asked(5))
    assert [(c.value, c.quality) for c in story.tags["ctd.sample_period_s"]] == [(0, "")]
    assert story.latency_ns == {("ctd", "read holding registers"): [10_000_000]}


def test_of_nothing_nothing_is_known() -> None:
    assert not compare(RunHistory(), RunHistory()).same


@given(
    st.lists(
        st.tuples(st.integers(0, 90), st.sampled_from([1.0, 2.0, None]), st.sampled_from(["good", "bad"])), max_size=8
    )
)
def test_a_run_is_the_same_as_itself(changes: list[tuple[int, float | None, str]]) -> None:
    events = [tag(t, "ctd.pressure", value, quality) for t, value, quality in changes]
    assert judge(events, events).same


def test_a_scenario_takes_something_to_expect() -> None:
    with pytest.raises(UsageError, match="this run has nothing to expect"):
        as_scenario(SYSTEM, RunHistory(), ScenarioOptions("x", "observatory"))


def test_a_virtual_run_becomes_a_scenario_that_passes_and_sees_a_change(tmp_path: Path) -> None:
    runner, trace, made = CliRunner(), tmp_path / "run.jsonl", tmp_path / "run.scenario.yaml"
    run = ["simulate", "observatory", "--for", "12s", "--commands", "1,0", "--seed", "3"]

    def said(*argv: str, code: int) -> str:
        result = runner.invoke(cli, argv, standalone_mode=False)
        assert result.exception is None, result.exception
        assert result.return_value == code
        return result.stdout

    said(*run, "--trace", str(trace), code=0)
    assert "the same" in said(*run, "--compare", str(trace), code=0)
    wrong = said(*[w.replace("1,0", "2,0") for w in run], "--compare", str(trace), code=1)
    assert "relay.period" in wrong
    other = tmp_path / "other.jsonl"
    lines = trace.read_text().splitlines()
    other.write_text("\n".join(line.replace('"ACTIVE"', '"OFF"') for line in lines) + "\n")
    judged = json.loads(said("trace", str(other), "observatory", "--against", str(trace), "--json", code=1))
    assert [(d["what"], d["where"]) for d in judged["differences"]] == [("order", "relay.state")]

    said("trace", str(trace), "observatory", "--as-scenario", str(made), "--seed", "3", code=0)
    text = made.read_text()
    assert "send: {period_s: 1}" in text
    assert "relay.state == 'ACTIVE'" in text
    result = run_virtual(load_scenario(made))
    assert result.verdict.value == "passed", [c for c in result.checks if c.verdict.value != "passed"]
    made.write_text(text.replace("period_s: 1", "period_s: 0", 1))
    assert run_virtual(load_scenario(made)).verdict.value == "failed"


def test_runs_without_anything_in_common_are_not_the_same() -> None:
    """Defect: an empty trace was "the same" as any older one, with all fields of that counted as compared."""
    old = run_history(SYSTEM, [*RELAY, *asked(5.0), tag(6.0, "ctd.pressure", 1.0)])
    for new in ([], [TraceEvent(0, TraceKind.NOTE, "start", {"text": "x"})]):
        verdict = compare(old, run_history(SYSTEM, new))
        assert not verdict.same
        assert verdict.compared == 0
    assert (verdict.common_s, verdict.old_s) == (0.0, 50.0)
