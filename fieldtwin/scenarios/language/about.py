"""Metadata of a scenario's result: its case id, the role under test, and its impact level.

This module does not run scenarios.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from fieldtwin.conformance.core.case import Impact
from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.scenarios.language.file_name import case_of
from fieldtwin.scenarios.language.form import Scenario
from fieldtwin.scenarios.language.words import Step, word_of

ROLE = "controller"
"""The role under test: the gateway and PLC of the system, or the controller that the scenario's probes read."""
_DANGER = {
    "send": Impact.WRITE,
    "set": Impact.WRITE,
    "acknowledge": Impact.WRITE,
    "fault": Impact.DISRUPT,
    "clear": Impact.DISRUPT,
}
"""Impact levels of steps; all other steps observe."""


def impacts(scenario: Scenario) -> Iterator[tuple[Impact, str]]:
    """Yield the impact level and a description of each step and probe."""
    for n, step in enumerate(scenario.form.steps, 1):
        yield _danger_of(step), f"step {n}"
    for probe in scenario.probes:
        yield Impact.READ, f"the probe {probe.name}"


def _danger_of(step: Step) -> Impact:
    return _DANGER.get(word_of(step), Impact.OBSERVE)


def impact_of(scenario: Scenario) -> Impact:
    """Return the highest impact level of all steps and probes of the scenario."""
    return max((impact for impact, _ in impacts(scenario)), key=lambda d: d.rank, default=Impact.OBSERVE)


def result_of(scenario: Scenario, target: str, verdict: Verdict, **more: Any) -> ScenarioResult:
    """Return a result with the scenario's metadata; `more` are the other fields of `ScenarioResult`."""
    return ScenarioResult(
        scenario.form.scenario,
        verdict,
        requirements=tuple(scenario.form.requirements),
        file=str(scenario.path),
        line=1,
        target=target,
        case=case_of(scenario.path),
        role=ROLE,
        impact=impact_of(scenario).value,
        **more,
    )
