"""Results of a judgement: waived or not, counted, as JSON and for the reports."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date
from typing import Any

from fieldtwin.conformance.case import About, Finding, failed
from fieldtwin.conformance.waivers import Waivers
from fieldtwin.report.model import CheckResult, Report, ScenarioResult, Verdict


@dataclass(frozen=True, slots=True)
class CaseResult:
    """A case and what was found. `waived`: the waiver's reason, where a failure is one that somebody answers for."""

    case: About
    finding: Finding
    took_s: float = 0.0
    waived: str = ""

    @property
    def verdict(self) -> Verdict:
        """A waived failure counts as skipped: it neither failed nor passed."""
        return Verdict.SKIPPED if self.waived else self.finding.verdict

    @property
    def reason(self) -> str:
        return f"waived: {self.waived} (failed: {self.finding.reason})" if self.waived else self.finding.reason


def waive(result: CaseResult, waivers: Waivers, today: date) -> CaseResult:
    """The result under its waiver, if there is one. An expired one is a failure that says so, whatever was found."""
    waiver = waivers.of(result.case.id, result.case.row)
    if waiver is None:
        return result
    if waiver.expired(today):
        found = f"; {result.finding.verdict.value}: {result.finding.reason}" if result.finding.reason else ""
        return replace(result, finding=failed(f"its waiver expired on {waiver.expires} ({waiver.reason}){found}"))
    if result.finding.verdict is Verdict.FAILED:
        return replace(result, waived=f"{waiver.reason}, until {waiver.expires}")
    return result


def exit_code(results: Sequence[CaseResult]) -> int:
    """1 when something failed, or nothing at all passed."""
    verdicts = Counter(result.verdict for result in results)
    return 1 if verdicts[Verdict.FAILED] or verdicts[Verdict.ERROR] or not verdicts[Verdict.PASSED] else 0


def summary(results: Sequence[CaseResult]) -> str:
    """``31 passed, 1 failed, 4 skipped, 2 inconclusive``."""
    verdicts = Counter(result.verdict for result in results)
    order = (Verdict.PASSED, Verdict.FAILED, Verdict.INCONCLUSIVE, Verdict.SKIPPED)
    return ", ".join(f"{verdicts[v]} {v.value}" for v in order if verdicts[v]) or "no case was chosen"


def as_json(results: Sequence[CaseResult]) -> list[dict[str, Any]]:
    """One object a case."""
    return [
        {
            "id": r.case.id,
            "title": r.case.title,
            "clause": r.case.clause,
            "role": r.case.role,
            "danger": r.case.danger.value,
            "device": r.case.does,
            "expected": r.case.must,
            "verdict": r.verdict.value,
            "reason": r.reason,
            "waived": bool(r.waived),
            "took_s": round(r.took_s, 3),
        }
        for r in results
    ]


def as_report(results: Sequence[CaseResult], title: str, reproduce: str, started: str) -> Report:
    """For `fieldtwin.report`: a scenario a case."""
    return Report(
        title, [_scenario(r, title, reproduce) for r in results], started=started, reproduce=reproduce, target=title
    )


def _scenario(result: CaseResult, target: str, reproduce: str) -> ScenarioResult:
    case = result.case
    check = CheckResult("1", f"{case.does}: {case.must}", result.verdict, expected=case.must, got=result.reason)
    return ScenarioResult(
        f"{case.id} {case.title}", result.verdict, [check], requirements=(case.row,), target=target, reason=result.reason,
        reproduce=f"{reproduce} --only {case.id}", took_s=result.took_s, case=case.id, role=case.role, danger=case.danger.value,
    )  # fmt: skip
