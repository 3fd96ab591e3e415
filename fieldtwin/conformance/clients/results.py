"""Results of a test of a client as JSON and for JUnit. The parts that tests of devices also need are in
`fieldtwin.conformance.core.results`.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from fieldtwin.conformance.core.case import Basis
from fieldtwin.conformance.core.evidence import reproduce
from fieldtwin.conformance.core.results import ONLY_REQUIRED, CaseResult, as_scenario, case_json, document, summary
from fieldtwin.results.model import Report

KIND = "fieldtwin check-client"
VERSION = 1


def as_json(about: Mapping[str, Any], results: Sequence[CaseResult], argv: Sequence[str]) -> dict[str, Any]:
    """Return the whole test of a client. `about` names the test, `argv` is the command line, for `reproduce`."""
    cases = [
        case_json(r, "device", reproduce=reproduce(argv, r.case.id), wire=[line.as_json() for line in r.wire])
        for r in results
    ]
    return document(KIND, VERSION, about, results, cases)


def as_report(
    results: Sequence[CaseResult],
    title: str,
    argv: Sequence[str],
    started: str,
    fail_on: frozenset[Basis] = ONLY_REQUIRED,
) -> Report:
    """Return the results as a JUnit report: a scenario for each case, with its frames."""
    again = shlex.join(["fieldtwin", *argv])
    scenarios = [
        as_scenario(r, title, reproduce(argv, r.case.id), fail_on, evidence=tuple(map(str, r.wire))) for r in results
    ]
    return Report(f"{title}: {summary(results)}", scenarios, started=started, reproduce=again, target=title)
