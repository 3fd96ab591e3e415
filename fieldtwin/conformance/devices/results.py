"""Results of a check of a device as JSON and for JUnit. `fieldtwin.conformance.core.results` summarises the verdicts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from fieldtwin.conformance.core.case import Basis
from fieldtwin.conformance.core.results import ONLY_REQUIRED, for_build, summary
from fieldtwin.conformance.devices.device_case import DeviceResult
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.results.model import CheckResult, Report, ScenarioResult
from fieldtwin.results.subject import Subject

KIND = "fieldtwin check"
VERSION = 2
"""2: each case has its `basis`, and `findings` counts the failures of each basis."""


def as_json(subject: Subject, results: Sequence[DeviceResult]) -> dict[str, Any]:
    """Return the whole check; ``fieldtwin report`` reads it."""
    return {
        "kind": KIND,
        "version": VERSION,
        "about": subject.as_json(),
        "counts": dict(Counter(r.verdict.value for r in results)),
        "findings": {basis.value: sum(r.verdict.bad and r.case.basis is basis for r in results) for basis in Basis},
        "cases": [_case(r) for r in results],
    }


def _case(result: DeviceResult) -> dict[str, Any]:
    case = result.case
    return {
        "id": case.id,
        "title": case.title,
        "clause": case.clause,
        "basis": case.basis.value,
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


def as_report(
    subject: Subject, results: Sequence[DeviceResult], reproduce: str, fail_on: frozenset[Basis] = ONLY_REQUIRED
) -> Report:
    """Return the results as a JUnit report: a scenario for each case, with its bytes in the output."""
    scenarios = []
    for r in results:
        verdict, reason = for_build(r, fail_on)
        said = "; ".join(f"{'>' if s.direction is Direction.SENT else '<'} {s.text}" for s in r.spoken)
        check = CheckResult("1", f"{r.case.does}: {r.case.must}", verdict, expected=r.case.must, got=reason)
        wire = [CheckResult("wire", said, verdict)] if said else []
        scenarios.append(
            ScenarioResult(
                f"{r.case.id} {r.case.title}", verdict, [check, *wire], requirements=(r.case.row,), target=subject.name,
                reason=reason, reproduce=f"{reproduce} --only {r.case.id}", took_s=r.took_s,
                case=r.case.id, role=r.case.role, danger=r.case.danger.value,
                basis=r.case.basis.value, clause=r.case.clause,
            )
        )  # fmt: skip
    versions = {"fieldtwin": subject.fieldtwin, **{f"device {name}": text for name, text in subject.identity.items()}}
    title = f"{subject.name}: {summary(results)}"
    return Report(
        title, scenarios, started=subject.started, reproduce=reproduce, target=subject.name, versions=versions
    )
