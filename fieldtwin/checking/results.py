"""Results of a check of a device as JSON and for JUnit. What the verdicts come to is `fieldtwin.conformance.results`'s."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from fieldtwin.checking.device_case import DeviceResult
from fieldtwin.checking.subject import Subject
from fieldtwin.conformance.results import summary
from fieldtwin.report.model import CheckResult, Report, ScenarioResult
from gateway.core.clock import NS_PER_MS
from gateway.core.connection import Direction

KIND = "fieldtwin check"
VERSION = 1


def as_json(subject: Subject, results: Sequence[DeviceResult]) -> dict[str, Any]:
    """The whole check: ``fieldtwin report`` reads this."""
    return {
        "kind": KIND,
        "version": VERSION,
        "about": subject.as_json(),
        "counts": dict(Counter(r.verdict.value for r in results)),
        "cases": [_case(r) for r in results],
    }


def _case(result: DeviceResult) -> dict[str, Any]:
    case = result.case
    return {
        "id": case.id,
        "title": case.title,
        "clause": case.clause,
        "role": case.role,
        "danger": case.danger.value,
        "sent": case.does,
        "expected": case.must,
        "verdict": result.verdict.value,
        "reason": result.reason,
        "waived": bool(result.waived),
        "took_s": round(result.took_s, 3),
        "wire": [
            {
                "t_ms": round(s.t_ns / NS_PER_MS, 3),
                "direction": "sent" if s.direction is Direction.SENT else "received",
                "data": s.text,
            }
            for s in result.spoken
        ],
    }


def as_report(subject: Subject, results: Sequence[DeviceResult], reproduce: str) -> Report:
    """For JUnit: a scenario a case, its bytes in the output."""
    scenarios = []
    for r in results:
        said = "; ".join(f"{'>' if s.direction is Direction.SENT else '<'} {s.text}" for s in r.spoken)
        check = CheckResult("1", f"{r.case.does}: {r.case.must}", r.verdict, expected=r.case.must, got=r.reason)
        wire = [CheckResult("wire", said, r.verdict)] if said else []
        scenarios.append(
            ScenarioResult(
                f"{r.case.id} {r.case.title}", r.verdict, [check, *wire], requirements=(r.case.row,), target=subject.name,
                reason=r.reason, reproduce=f"{reproduce} --only {r.case.id}", took_s=r.took_s,
                case=r.case.id, role=r.case.role, danger=r.case.danger.value,
            )
        )  # fmt: skip
    versions = {"fieldtwin": subject.fieldtwin, **{f"device {name}": text for name, text in subject.identity.items()}}
    title = f"{subject.name}: {summary(results)}"
    return Report(
        title, scenarios, started=subject.started, reproduce=reproduce, target=subject.name, versions=versions
    )
