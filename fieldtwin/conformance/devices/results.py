"""Results of a check of a device as JSON and for JUnit. `fieldtwin.conformance.core.results` summarises the verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fieldtwin.conformance.core.case import Basis
from fieldtwin.conformance.core.results import ONLY_REQUIRED, as_scenario, case_json, document, summary
from fieldtwin.conformance.devices.device_case import DeviceResult, Spoken
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.results.model import Report
from fieldtwin.results.subject import Subject

KIND = "fieldtwin check"
VERSION = 2
"""Version of the JSON document. 2: each case has its `basis`, and `findings` counts the failures of each basis."""


def as_json(subject: Subject, results: Sequence[DeviceResult]) -> dict[str, Any]:
    """Return the whole check as data for JSON, which ``fieldtwin report`` reads."""
    cases = [case_json(r, "sent", wire=[_spoken_json(s) for s in r.spoken]) for r in results]
    return document(KIND, VERSION, subject.as_json(), results, cases)


def _spoken_json(spoken: Spoken) -> dict[str, Any]:
    return {
        "t_ms": round(spoken.t_ns / NS_PER_MS, 3),
        "direction": "sent" if spoken.direction is Direction.SENT else "received",
        "data": spoken.text,
    }


def as_report(
    subject: Subject, results: Sequence[DeviceResult], reproduce: str, fail_on: frozenset[Basis] = ONLY_REQUIRED
) -> Report:
    """Return the results as a JUnit report: a scenario for each case, with the bytes sent and received in its output."""
    scenarios = []
    for r in results:
        wire = "; ".join(f"{'>' if s.direction is Direction.SENT else '<'} {s.text}" for s in r.spoken)
        scenarios.append(as_scenario(r, subject.name, f"{reproduce} --only {r.case.id}", fail_on, wire))
    versions = {"fieldtwin": subject.fieldtwin, **{f"device {name}": text for name, text in subject.identity.items()}}
    title = f"{subject.name}: {summary(results)}"
    return Report(
        title, scenarios, started=subject.started, reproduce=reproduce, target=subject.name, versions=versions
    )
