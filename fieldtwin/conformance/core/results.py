"""Results of conformance tests of devices and clients: waived or not, counted, as JSON and for the reports."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from typing import Any, TypeVar

from fieldtwin.book import case_url
from fieldtwin.conformance.core.case import About, Basis, Finding, failed
from fieldtwin.conformance.core.evidence import Line
from fieldtwin.conformance.core.waivers import Waivers
from fieldtwin.results.model import CheckResult, ScenarioResult, Verdict


@dataclass(frozen=True, slots=True)
class CaseResult:
    """A case and its finding. `waived`: the waiver's reason, owner and expiry date, if a failure is accepted."""

    case: About
    finding: Finding
    took_s: float = 0.0
    waived: str = ""
    wire: tuple[Line, ...] = ()
    """The frames and events on which the verdict is based."""

    @property
    def verdict(self) -> Verdict:
        """Return the verdict. A waived failure counts as skipped: it neither failed nor passed."""
        return Verdict.SKIPPED if self.waived else self.finding.verdict

    @property
    def deviates(self) -> bool:
        """Return whether a case failed that the standard requires."""
        return self.verdict.bad and self.case.basis is Basis.STANDARD

    @property
    def reason(self) -> str:
        return f"waived: {self.waived} (failed: {self.finding.reason})" if self.waived else self.finding.reason


R = TypeVar("R", bound=CaseResult)


def waive(result: R, waivers: Waivers, today: date) -> R:
    """Return the result with its waiver applied, if there is one. An expired waiver is a failure, independent of the finding."""
    waiver = waivers.of(result.case.id, result.case.row)
    if waiver is None:
        return result
    if waiver.expired(today):
        found = f"; {result.finding.verdict.value}: {result.finding.reason}" if result.finding.reason else ""
        text = f"its waiver expired on {waiver.expires} ({waiver.reason}; owner {waiver.owner}){found}"
        return replace(result, finding=failed(text))
    if result.finding.verdict is Verdict.FAILED:
        return replace(result, waived=str(waiver))
    return result


ONLY_REQUIRED = frozenset({Basis.STANDARD})
FOUND = {Basis.STANDARD: "failed", Basis.ROBUSTNESS: "robustness", Basis.FIELD: "field problem"}
"""The name of a failed case in tables and counts, by the basis of the case."""


def counts_as_failed(result: CaseResult, fail_on: frozenset[Basis] = ONLY_REQUIRED) -> bool:
    """Return whether the result affects the exit code: it failed, and its case's basis is one of `fail_on`."""
    return result.verdict is Verdict.ERROR or (result.verdict.bad and result.case.basis in fail_on)


def exit_code(results: Sequence[CaseResult], fail_on: frozenset[Basis] = ONLY_REQUIRED) -> int:
    """Return 1 when a case failed whose basis is one of `fail_on`, or when no case passed; else 0."""
    passed = any(result.verdict is Verdict.PASSED for result in results)
    return 1 if not passed or any(counts_as_failed(result, fail_on) for result in results) else 0


def called(result: CaseResult) -> str:
    """Return ``passed``, ``failed``, ``robustness``, ``field problem``, ``inconclusive`` or ``skipped``.

    ``robustness`` and ``field problem`` are failures that do not deviate from a standard.
    """
    return FOUND[result.case.basis] if result.verdict is Verdict.FAILED else result.verdict.value


def summary(results: Sequence[CaseResult]) -> str:
    """Return a text such as ``31 passed, 1 failed, 2 robustness, 1 field problem, 2 inconclusive, 4 skipped``."""
    counts = Counter(called(result) for result in results)
    order = ("passed", *FOUND.values(), "error", "inconclusive", "skipped")
    return ", ".join(f"{counts[word]} {word}" for word in order if counts[word]) or "no case was chosen"


def document(
    kind: str, version: int, about: Mapping[str, Any], results: Sequence[CaseResult], cases: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Return a whole test as data for JSON. `about` names the test, `cases` are its results (`case_json`)."""
    return {
        "kind": kind,
        "version": version,
        "about": dict(about),
        "counts": dict(Counter(r.verdict.value for r in results)),
        "findings": {basis.value: sum(r.verdict.bad and r.case.basis is basis for r in results) for basis in Basis},
        "cases": list(cases),
    }


def case_json(result: CaseResult, action: str, **more: Any) -> dict[str, Any]:
    """Return a result as data for JSON. `action` is the key of the checker's action, `more` further keys."""
    case = result.case
    return {
        "id": case.id,
        "title": case.title,
        "clause": case.clause,
        "basis": case.basis.value,
        "role": case.role,
        "impact": case.impact.value,
        action: case.does,
        "expected": case.must,
        "verdict": result.verdict.value,
        "reason": result.reason,
        "waived": bool(result.waived),
        "took_s": round(result.took_s, 3),
        **({"page": url} if (url := case_url(case.id)) else {}),
        **more,
    }


def for_build(result: CaseResult, fail_on: frozenset[Basis]) -> tuple[Verdict, str]:
    """Return the verdict and the reason that a build's test report shows.

    A failure that does not decide the exit code is SKIPPED there, with its kind in front of the reason. So a build and its test
    report agree. INCONCLUSIVE does not decide it either, and is SKIPPED as well.
    """
    if result.verdict is Verdict.INCONCLUSIVE:
        return Verdict.SKIPPED, f"inconclusive: {result.reason}"
    if not result.verdict.bad or counts_as_failed(result, fail_on):
        return result.verdict, result.reason
    return Verdict.SKIPPED, f"{called(result)} finding: {result.reason}"


def as_scenario(
    result: CaseResult, target: str, again: str, fail_on: frozenset[Basis], wire: str = "", evidence: Sequence[str] = ()
) -> ScenarioResult:
    """Return a result for a build's test report.

    `again` is the command that repeats the case, `wire` are its frames as text, `evidence` its frames and events as lines.
    """
    case = result.case
    verdict, reason = for_build(result, fail_on)
    checks = [CheckResult("1", f"{case.does}: {case.must}", verdict, expected=case.must, got=reason)]
    if wire:
        checks.append(CheckResult("wire", wire, verdict))
    return ScenarioResult(
        f"{case.id} {case.title}", verdict, checks, requirements=(case.row,), target=target, reason=reason,
        reproduce=again, took_s=result.took_s, case=case.id, role=case.role, impact=case.impact.value,
        basis=case.basis.value, clause=case.clause, evidence=tuple(evidence),
    )  # fmt: skip
