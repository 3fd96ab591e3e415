"""The statements of a report agree with the trace: headlines, times, values, counts and "never published".

Defects: the headline named a step that was not yet due when a `within` rule broke; "never published" was printed next to a
quoted value; an unreachable probe was reported as "plc.running: never published".
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fieldtwin.capture.decoding.decoder import exchanges
from fieldtwin.gateway.core.conditions.expression import Expression
from fieldtwin.results.model import CheckResult, ScenarioResult, Verdict
from fieldtwin.results.trace import TraceEvent, TraceKind
from fieldtwin.run.targets.scenario_targets import ScenarioTarget, run_scenario
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.scenarios.language.form import Scenario, load_scenario

SYSTEM = Path(__file__).parents[1] / "emulators" / "faults" / "scenarios" / "line.yaml"
NS = 1_000_000_000
STALE_S = 0.9
TAGS = ("probe.level", "probe.flow", "other.level", "watch.seen", "watch.level_ok", "probe.setpoint")
NUMBERS = ("probe.level", "probe.flow", "other.level", "watch.seen")

TIMES = st.sampled_from(["100ms", "300ms", "1s", "1500ms"])
CONDITIONS = st.one_of(
    st.builds(
        lambda name, op, number: f"{name} {op} {number}",
        st.sampled_from(NUMBERS), st.sampled_from(["<", ">", "==", "!="]), st.sampled_from([0, 42, 77, 120, 1042]),
    ),
    st.builds(
        lambda name, quality: f"quality({name}) == '{quality}'", st.sampled_from(TAGS[:3]), st.sampled_from(["good", "bad"])
    ),
    st.builds(lambda name, age: f"age({name}) < {age}", st.sampled_from(TAGS[:3]), st.sampled_from(["0.3 s", "0.8 s"])),
)  # fmt: skip
STEPS = st.lists(
    st.one_of(
        st.builds(lambda t: f"pause: {t}", TIMES),
        st.builds(
            lambda tag, value: f"set: {{tag: {tag}, value: {value}}}",
            st.sampled_from(["probe.level", "other.level"]), st.sampled_from([1, 120]),
        ),
        st.builds(
            lambda name, device: f"fault: {{name: {name}, device: {device}, until: 1h}}",
            st.sampled_from(["silence", "corrupt-crc", "delay"]), st.sampled_from(["probe", "other"]),
        ),
        st.builds(lambda e, t: f'wait: {{until: "{e}", within: {t}}}', CONDITIONS, TIMES),
        st.builds(lambda e, t, d: f'expect: {{that: "{e}", within: {t}, during: {d}}}', CONDITIONS, TIMES, TIMES),
        st.builds(
            lambda tag, q, t: f"expect: {{tag: {tag}, quality: {q}, within: {t}}}",
            st.sampled_from(TAGS), st.sampled_from(["good", "bad"]), TIMES,
        ),
        st.builds(
            lambda tag, low: f"expect: {{tag: {tag}, updates_per_s: [{low}, {low + 3}], during: 1s}}",
            st.sampled_from(TAGS[:3]), st.sampled_from([0, 4, 9]),
        ),
        st.builds(
            lambda device, n, t: f"expect: {{wire: {device}, times: {{min: 1, max: {n}}}, within: {t}}}",
            st.sampled_from(["probe", "other"]), st.sampled_from([1, 5, 50]), TIMES,
        ),
    ),
    min_size=1, max_size=5,
)  # fmt: skip
RULES = st.lists(
    st.one_of(
        st.builds(lambda e: ("always", f'"{e}"'), CONDITIONS),
        st.builds(lambda e: ("never", f'"{e}"'), CONDITIONS),
        st.builds(
            lambda a, b, t: ("within", f'{{after: "{a}", then: "{b}", within: {t}}}'), CONDITIONS, CONDITIONS, TIMES
        ),
        st.builds(
            lambda tag, n: ("rate", f"{{tag: {tag}, updates_per_s: {{max: {n}}}, over: 1s}}"),
            st.sampled_from(TAGS[:3]), st.sampled_from([2, 20]),
        ),
        st.builds(
            lambda name, t: ("cycle", f"{{changes_of: {name}, min: {t}}}"),
            st.sampled_from(["watch.seen", "probe.level", "watch.level_ok"]), TIMES,
        ),
    ),
    max_size=3,
)  # fmt: skip


class Past:
    """Return the values known at each time, from the trace alone."""

    def __init__(self, scenario: Scenario, trace: Sequence[TraceEvent]) -> None:
        self.scenario = scenario
        self.trace = trace

    def of(
        self, name: str, kinds: tuple[TraceKind, ...] = (TraceKind.TAG, TraceKind.STATE), until_s: float = 1e9
    ) -> list[TraceEvent]:
        device = name.partition(".")[0] in self.scenario.system.devices
        kinds = tuple(kind for kind in kinds if kind is (TraceKind.TAG if device else TraceKind.STATE))
        return [e for e in self.trace if e.kind in kinds and e.where == name and e.t_ns <= round(until_s * NS)]

    def look(self, at_s: float) -> Any:
        def look(function: str, name: str) -> Any:
            seen = self.of(name, until_s=at_s)
            if not seen or seen[-1].data["value"] is None:
                return None
            fresh = seen[-1].data.get("quality", "good")
            return seen[-1].data["value"] if function == "value" else fresh if function == "quality" else None

        return look

    def truth(self, text: str, at_s: float) -> bool | None:
        return Expression(text, self.scenario.known, self.scenario.words).truth(self.look(at_s))


QUOTE = re.compile(
    r"(?P<name>\w+\.\w+): (?P<value>\S+) (?P<quality>good|bad)(?: \((?P<why>[^)]*)\))?, (?P<age>[\d.]+) s old"
)


def check_quotes(past: Past, check: CheckResult) -> None:
    """Each quoted value was the last one in the trace; a value reported as never published is not in the trace."""
    assert check.t_ns is not None
    at_s = check.t_ns / NS
    for found in QUOTE.finditer(check.got):
        seen = past.of(found["name"], until_s=at_s)
        assert seen, f"{found['name']} is quoted, and not in the trace"
        assert found["value"] == repr(seen[-1].data["value"])
        said = seen[-1].data.get("quality", "good")
        stale = found["quality"] == "bad" and found["why"] == "stale"
        assert found["quality"] == said or (stale and float(found["age"]) > STALE_S)
    for name, said in re.findall(r"(\w+\.\w+): (never published|never read back|no value yet)", check.got):
        seen = past.of(name, until_s=at_s)
        assert all(e.data["value"] is None for e in seen)
        assert not seen or said != "never published"


def check_rule(past: Past, check: CheckResult) -> None:
    """Times and counts in the message of a broken rule."""
    word, _, number = check.number.partition(" ")
    form = past.scenario.form
    if word in ("always", "never") and "age(" not in check.text:
        assert check.t_ns is not None
        assert past.truth(check.text, check.t_ns / NS) is (word == "never") or "stale" in check.got
    elif word == "within" and (
        found := re.search(r"at ([\d.]+) s, and the second did not hold until ([\d.]+) s", check.got)
    ):
        rule = form.within[int(number) - 1]
        if (
            "age(" not in rule.after + rule.then
            and "stale" not in check.got
            and "quality(" not in rule.after + rule.then
        ):
            assert past.truth(rule.after, float(found[1]) + 0.0006) is True
            assert past.truth(rule.then, float(found[2]) - 0.0006) is not True
    elif word == "rate":
        found = re.search(r"([\d.e+-]+)/s: (\d+) from ([\d.]+) s to ([\d.]+) s", check.got)
        assert found is not None
        tag = form.rate[int(number) - 1].tag or ""
        since_s, until_s, count = float(found[3]), float(found[4]), int(found[2])
        low = sum(since_s + 0.001 < e.t_ns / NS < until_s - 0.001 for e in past.of(tag))
        high = sum(since_s - 0.001 <= e.t_ns / NS <= until_s + 0.001 for e in past.of(tag))
        assert low <= count <= high
    elif word == "cycle":
        found = re.search(r"([\d.]+) s, from ([\d.]+) s to ([\d.]+) s", check.got)
        assert found is not None
        assert float(found[1]) == pytest.approx(float(found[3]) - float(found[2]), abs=0.002)
        times = [e.t_ns / NS for e in past.of(form.cycle[int(number) - 1].changes_of or "")]
        assert all(any(abs(t - float(said)) < 0.001 for t in times) for said in (found[2], found[3]))


def check_step(past: Past, result: ScenarioResult, check: CheckResult) -> None:
    """A failed step was due: it began after the previous one, and the trace has its start and its verdict."""
    marks = [e for e in past.trace if e.kind is TraceKind.STEP and e.where == check.number]
    assert [e.t_ns for e in marks] == [check.since_ns, check.t_ns]
    assert marks[-1].data["verdict"] == check.verdict.value
    expect = past.scenario.form.steps[int(check.number) - 1].expect
    if check.verdict is Verdict.FAILED and expect is not None and expect.times is not None:
        begun = [e.t_ns for e in past.trace if e.kind is TraceKind.STEP and "verdict" not in e.data]
        words = ("send", "set", "fault", "clear")
        stimuli = [
            t for t, s in zip(begun, past.scenario.form.steps, strict=False) if any(getattr(s, w) for w in words)
        ]
        since_ns = max((t for t in stimuli if t <= (check.since_ns or 0)), default=0)
        seen = [
            x
            for x in exchanges(past.scenario.system, past.trace)
            if x.device == expect.wire and since_ns <= x.t_ns <= (check.t_ns or 0)
        ]
        over = [x for x in seen if x.reply_text != "no reply"]
        assert len(over) <= int(check.got.partition(":")[0]) <= len(seen)  # one request may still be unanswered


def check_headline(result: ScenarioResult) -> None:
    named = result.reason.partition(": ")[0].removeprefix("step ")
    if result.verdict is Verdict.PASSED or not named or "has no expectation" in result.reason:
        return
    if named == "set":
        named = f"set {result.reason.split()[1]}"
    (check,) = (c for c in result.checks if c.number == named)
    assert check.verdict is result.verdict
    assert (
        all(c.verdict is not Verdict.FAILED for c in result.checks if c is not check)
        or result.verdict is Verdict.FAILED
    )


@given(STEPS, RULES)
@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
def test_the_statements_of_a_report_are_true_of_the_trace(
    tmp_path_factory: pytest.TempPathFactory, steps: list[str], rules: list[tuple[str, str]]
) -> None:
    path = SYSTEM.parent / "unused.scenario.yaml"
    folder = tmp_path_factory.mktemp("report")
    path = folder / "x.scenario.yaml"
    head = "".join(
        f"{word}:\n" + "".join(f"  - {text}\n" for other, text in rules if other == word)
        for word in {w for w, _ in rules}
    )
    path.write_text(
        f"scenario: a report\nsystem: {SYSTEM}\n{head}steps:\n" + "".join(f"  - {step}\n" for step in steps)
    )
    scenario = load_scenario(path)
    result = run_virtual(scenario)
    past = Past(scenario, result.trace)
    check_headline(result)
    for check in result.checks:
        check_quotes(past, check)
        if check.number.isdigit():
            check_step(past, result, check)
        elif check.verdict is Verdict.FAILED:
            check_rule(past, check)
    for check in result.checks:  # whether the programs run is not a line of the scenario
        assert check.verdict is not Verdict.FAILED or check.where.startswith(str(path)) or check.number == "running"


def written(folder: Path, text: str, system: str = "observatory") -> Path:
    path = folder / "x.scenario.yaml"
    path.write_text(f"scenario: a report\nsystem: {system}\n{text}")
    return path


def test_the_headline_names_the_rule_that_broke_and_not_the_step_that_it_interrupted(tmp_path: Path) -> None:
    text = (
        "within: [{after: \"relay.state == 'ACTIVE'\", then: 'ctd.sample_period_s == 9', within: 2s}]\n"
        "steps:\n  - send: {period_s: 1}\n  - wait: {until: 'relay.period == 7', within: 20s}\n"
    )
    result = run_virtual(load_scenario(written(tmp_path, text)))
    assert result.verdict is Verdict.FAILED
    assert result.reason.startswith("within 1: ")
    step, rule = result.checks[-2:]
    assert (step.number, step.verdict) == ("2", Verdict.INCONCLUSIVE)
    assert (rule.number, rule.verdict, rule.where) == ("within 1", Verdict.FAILED, f"{tmp_path}/x.scenario.yaml:3")
    assert rule.since_ns is not None
    assert rule.t_ns is not None
    assert rule.t_ns - rule.since_ns == pytest.approx(2 * NS, abs=NS // 25)


@pytest.mark.long
def test_an_unreachable_probe_is_reported_with_its_endpoint_and_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    text = (
        "probes:\n  far: {endpoint: 'tcp://127.0.0.1:1', registers: {running: {at: 40001}}}\n"
        "steps:\n  - wait: {until: 'far.running == 1', within: 2s}\n"
    )
    result = run_scenario(load_scenario(written(tmp_path, text)), ScenarioTarget("local"))
    assert result.verdict in (Verdict.FAILED, Verdict.INCONCLUSIVE)
    got = result.checks[-1].got
    assert "the probe far at tcp://127.0.0.1:1: " in got
    assert "refused" in got
