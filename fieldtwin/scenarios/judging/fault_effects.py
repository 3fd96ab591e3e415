"""Detects faults and set values that had no effect. A scenario that passes although its fault had no effect proves nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

from fieldtwin.results.model import CheckResult, Struck, Verdict
from fieldtwin.scenarios.language.form import Scenario
from fieldtwin.scenarios.language.words import Step


def fault_id(n: int, step: Step) -> str:
    """Return the id of the fault that step `n` (from 0) injects."""
    assert step.fault is not None
    return str(step.fault.get("id") or f"step {n + 1}")


def without_effect(scenario: Scenario, struck: Sequence[Struck], now_ns: int) -> Iterator[tuple[CheckResult, str]]:
    """Yield an inconclusive result for each fault that never took effect, then for each value that was set without effect.

    Each comes with the reason that is given for the verdict on the scenario.
    """
    steps = {fault_id(n, step): n for n, step in enumerate(scenario.form.steps) if step.fault is not None}
    for one in struck:
        if one.is_set or one.struck or one.optional:
            continue
        where = scenario.line("steps", steps[one.id]) if one.id in steps else ""
        text = f"{one.name} takes effect on {one.on}"
        got = "never took effect, so it tested nothing; if this is acceptable, set optional: true"
        result = CheckResult(
            f"fault {one.id}", text, Verdict.INCONCLUSIVE, now_ns, 0, text, got, where=where, vacuous=True
        )
        yield result, f"fault {one.id}: {text}: {got}"
    effect = Counter[str]()
    for one in struck:
        if one.is_set:
            effect[one.on] += one.struck
    for tag in (tag for tag, times in effect.items() if not times):
        text = f"set: {tag} takes effect"
        got = "no effect: the device has not sent the value since it was set"
        result = CheckResult(f"set {tag}", text, Verdict.INCONCLUSIVE, now_ns, 0, text, got, vacuous=True)
        yield result, f"{text}: {got}"
