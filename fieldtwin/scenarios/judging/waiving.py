"""Waivers of scenarios (accepted failures with an expiry date), in the form of `fieldtwin.conformance.core.waivers`.

The ID of a scenario is its file's name without .scenario.yaml, or the name in the scenario.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import date
from pathlib import Path

from fieldtwin.conformance.core.waivers import Waivers
from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.scenarios.language.file_name import case_of

_WAIVED = "waived: "


def ids_of(path: Path, name: str) -> tuple[str, str]:
    """Return the ids that a waiver may use for a scenario: its case ID and its name."""
    return case_of(path), name


def waive(result: ScenarioResult, waivers: Waivers, today: date) -> ScenarioResult:
    """Apply a waiver: a waived failure is SKIPPED, with the reason; under an expired waiver every result is a failure."""
    waiver = waivers.of(*ids_of(Path(result.file), result.name))
    if waiver is None:
        return result
    found = f"; {result.verdict.value}: {result.reason}" if result.reason else ""
    if waiver.expired(today):
        reason = f"its waiver expired on {waiver.expires} ({waiver.reason}; owner {waiver.owner}){found}"
        return replace(result, verdict=Verdict.FAILED, reason=reason)
    if result.verdict is Verdict.FAILED:
        reason = f"{_WAIVED}{waiver} (failed: {result.reason})"
        return replace(result, verdict=Verdict.SKIPPED, reason=reason)
    return result


def all_well(results: Iterable[ScenarioResult]) -> bool:
    """Return whether at least one scenario passed, and every other scenario passed or failed under a valid waiver."""
    found = list(results)
    waived = [r.verdict is Verdict.SKIPPED and r.reason.startswith(_WAIVED) for r in found]
    passed = [r.verdict is Verdict.PASSED for r in found]
    return any(passed) and all(a or b for a, b in zip(passed, waived, strict=True))
