"""The result of a scenario as plain data, for `fieldtwin test --json`."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fieldtwin.results.model import ScenarioResult


def plain_result(result: ScenarioResult) -> dict[str, object]:
    """Return the result as plain data."""
    from fieldtwin.run.campaigns.coverage import Coverage

    return {
        "name": result.name,
        "case": result.case,
        "role": result.role,
        "impact": result.impact,
        "verdict": result.verdict.value,
        "seed": result.seed,
        "target": result.target,
        "reason": result.reason,
        "attempts": result.attempts,
        "inconclusive_attempts": list(result.earlier),
        "requirements": list(result.requirements),
        "simulated_s": result.simulated_s,
        "trace": result.trace_hash,
        "trace_file": result.trace_file,
        "coverage": Coverage.parse(result.coverage).counts(),
        "reproduce": result.reproduce,
        "faults": [asdict(fault) for fault in result.faults],
        "checks": [
            {
                "number": c.number,
                "text": c.text,
                "verdict": c.verdict.value,
                "t_s": None if c.t_ns is None else c.t_ns / 1e9,
                "expected": c.expected,
                "got": c.got,
                "reason": c.reason,
                "where": c.where,
            }
            for c in result.checks
        ],
        "on_the_wire": list(result.evidence),
    }
