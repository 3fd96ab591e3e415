"""Three-valued logic: unknown values stay unknown, and no expectation passes because of them.

Defect: ``not (sensor.level > 1)`` was true while the tag had never been read, and ``quality(x) == 'bad'`` passed for a tag
that was never published.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.gateway.core.conditions.expression import Expression
from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.scenarios.language.form import load_scenario

NAMES = ("a.x", "b.y", "c.z")
NUMBERS = st.sampled_from(
    ["a.x", "b.y", "c.z", "0", "1", "2.5", "(a.x + 1)", "(b.y / a.x)", "(-c.z)", "(a.x * b.y - 2)"]
)
COMPARISONS = st.builds(
    lambda left, op, right: f"({left} {op} {right})",
    NUMBERS, st.sampled_from(["==", "!=", "<", "<=", ">", ">="]), NUMBERS,
)  # fmt: skip
EXPRESSIONS = st.recursive(
    COMPARISONS,
    lambda inner: st.one_of(
        st.builds(lambda e: f"(not {e})", inner),
        st.builds(lambda a, op, b: f"({a} {op} {b})", inner, st.sampled_from(["and", "or"]), inner),
    ),
    max_leaves=6,
)
VALUES = st.sampled_from([-1, 0, 1, 2, 2.5, True, float("nan"), None])


def truth(text: str, values: dict[str, Any]) -> bool | None:
    return Expression(text, NAMES).truth(lambda function, name: values[name])


def known_values(value: Any) -> tuple[Any, ...]:
    return (-1, 0, 1, 2, 2.5, 7) if value is None or value != value else (value,)


@given(EXPRESSIONS, VALUES, VALUES, VALUES)
@settings(max_examples=400, deadline=None)
def test_a_known_verdict_holds_whatever_the_unknown_values_are(text: str, x: Any, y: Any, z: Any) -> None:
    """Kleene's logic is sound: the result is true or false only if no value of the unknown tags could change it."""
    said = truth(text, {"a.x": x, "b.y": y, "c.z": z})
    if said is None:
        return
    for values in product(known_values(x), known_values(y), known_values(z)):
        assert truth(text, dict(zip(NAMES, values, strict=True))) in (said, None)


@given(EXPRESSIONS, VALUES, VALUES, VALUES)
@settings(max_examples=200, deadline=None)
def test_not_keeps_the_unknown_and_turns_the_known(text: str, x: Any, y: Any, z: Any) -> None:
    values = {"a.x": x, "b.y": y, "c.z": z}
    said, negated = truth(text, values), truth(f"not {text}", values)
    assert negated is (None if said is None else not said)
    assert truth(f"{text} or true", values) is True
    assert truth(f"{text} and false", values) is False
    assert truth(f"{text} and true", values) is said
    assert truth(f"{text} or false", values) is said


@given(COMPARISONS)
@settings(max_examples=200, deadline=None)
def test_a_comparison_with_nothing_known_is_unknown(text: str) -> None:
    expression = Expression(text, NAMES)
    if expression.names:
        assert expression.truth(lambda function, name: None) is None


def run(folder: Path, steps: str, head: str = "") -> ScenarioResult:
    path = folder / "x.scenario.yaml"
    path.write_text(f"scenario: a test\nsystem: observatory\n{head}steps:\n{steps}")
    return run_virtual(load_scenario(path))


PAUSE = "  - pause: 2s\n"
DEAD = "  - fault: {id: dead, name: silence, device: ctd}\n  - send: {period_s: 1}\n  - pause: 6s\n"
"""In standby the CTD is not read; with this fault it never answers, and its tags are bad without ever having had a value."""


@pytest.mark.parametrize(
    ("head", "steps", "verdict", "told"),
    [
        ("", "  - expect: {that: 'not (ctd.pressure > 1)'}\n", Verdict.FAILED, "never published"),
        ("", "  - expect: {that: 'not (ctd.pressure > 1)', during: 2s}\n", Verdict.FAILED, "unknown"),
        ("", "  - expect: {that: 'ctd.pressure != 3'}\n", Verdict.FAILED, "unknown"),
        ("", "  - wait: {until: 'not (ctd.pressure > 1)', within: 1s}\n", Verdict.FAILED, "unknown"),
        ("", "  - expect: {that: \"quality(ctd.pressure) == 'bad'\"}\n", Verdict.FAILED, "unknown"),
        ("", "  - expect: {that: \"reason(ctd.pressure) != 'timeout'\"}\n", Verdict.FAILED, "unknown"),
        ("", "  - expect: {tag: ctd.pressure, quality: bad}\n", Verdict.FAILED, "never published"),
        ("", DEAD + "  - expect: {tag: ctd.pressure, quality: bad}\n", Verdict.FAILED, "no value yet"),
        ("", DEAD + "  - expect: {that: \"quality(ctd.pressure) == 'bad'\"}\n", Verdict.FAILED, "no value"),
        ("always: ['not (ctd.pressure > 1)']\n", PAUSE, Verdict.INCONCLUSIVE, "there was never a value"),
        ("never: ['ctd.pressure > 1']\n", PAUSE, Verdict.INCONCLUSIVE, "there was never a value"),
        ("never: ['ctd.pressure > 1']\n", DEAD, Verdict.INCONCLUSIVE, "there was never a value"),
        (
            "within: [{after: \"relay.state == 'STANDBY'\", then: 'ctd.pressure != 1', within: 1s}]\n",
            PAUSE,
            Verdict.FAILED,
            "unknown at",
        ),
        (
            "within: [{after: 'not (ctd.pressure > 1)', then: \"relay.state == 'STANDBY'\", within: 1s}]\n",
            PAUSE,
            Verdict.INCONCLUSIVE,
            "nothing to check",
        ),
        (
            "rate: [{tag: inclinometer.slope_long, updates_per_s: {max: 99}, over: 1s, while: 'not (ctd.pressure > 1)'}]\n",
            PAUSE,
            Verdict.INCONCLUSIVE,
            "nothing to check",
        ),
        (
            "rate: [{tag: ctd.pressure, updates_per_s: {max: 99}, over: 1s}]\n",
            PAUSE,
            Verdict.INCONCLUSIVE,
            "was never published",
        ),
        (
            "cycle: [{late: 1s, while: 'not (ctd.pressure > 1)'}]\n",
            PAUSE,
            Verdict.INCONCLUSIVE,
            "nothing to check",
        ),
        (
            "never: [{wire: inclinometer, function: 5, unless: 'not (ctd.pressure > 1)'}]\n",
            PAUSE,
            Verdict.PASSED,
            "exchanges seen",
        ),
    ],
)  # fmt: skip
def test_no_construct_passes_on_unknown_values(
    tmp_path: Path, head: str, steps: str, verdict: Verdict, told: str
) -> None:
    result = run(tmp_path, steps, head)
    assert result.verdict is verdict, result.checks
    assert any(told in check.got for check in result.checks), result.checks


@pytest.mark.parametrize(
    ("head", "verdict"),
    [
        ("always: ['not (ctd.pressure > 1000)']\n", Verdict.PASSED),
        ("always: ['not (ctd.pressure / (ctd.sample_count - ctd.sample_count) > 1000)']\n", Verdict.INCONCLUSIVE),
        ("always: ['ctd.pressure > 1000 or ctd.pressure / 0 > 1 or ctd.pressure > 0']\n", Verdict.PASSED),
    ],
)
def test_a_rule_is_checked_from_when_its_values_are_known(tmp_path: Path, head: str, verdict: Verdict) -> None:
    steps = (
        "  - send: {period_s: 1}\n  - wait: {until: \"quality(ctd.pressure) == 'good'\", within: 15s}\n  - pause: 2s\n"
    )
    result = run(tmp_path, steps, head)
    assert result.verdict is verdict, result.checks[-1]


def test_a_rule_that_becomes_unknown_is_inconclusive_and_states_since_when(tmp_path: Path) -> None:
    """The temperature is 0 for a while, so a quotient by it has no value."""
    steps = (
        "  - send: {period_s: 1}\n  - wait: {until: \"quality(ctd.pressure) == 'good'\", within: 15s}\n  - pause: 3s\n"
        "  - set: {tag: ctd.temperature, value: 0}\n  - wait: {until: 'ctd.temperature == 0', within: 5s}\n  - pause: 1s\n"
    )
    result = run(tmp_path, steps, "always: ['not (ctd.pressure / ctd.temperature > 1000)']\n")
    assert result.verdict is Verdict.INCONCLUSIVE, result.reason
    assert "; no value in " in result.checks[-1].got
    assert result.reason.startswith("always 1: ")


@pytest.mark.parametrize("said", ["times: 0, within: 1ms", "requests_per_s: {max: 9}, during: 1ms"])
def test_no_exchange_on_an_unobserved_wire_is_not_evidence(tmp_path: Path, said: str) -> None:
    result = run(tmp_path, f"  - expect: {{wire: ctd, {said}}}\n")
    assert result.verdict is Verdict.INCONCLUSIVE, result.checks
    assert "no exchange with ctd" in result.checks[0].got
