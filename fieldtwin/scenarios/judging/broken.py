"""Exceptions for failed checks: of one step, and of the rules of the whole run."""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.results.model import CheckResult, Verdict
from fieldtwin.scenarios.judging.lateness import Allowance


@dataclass
class Broken(Exception):
    """A check that failed: the verdict, the expected and the actual value.

    `bound_s` is the time limit that it checks, 0 for none; `since_s` is the time from which the host's lateness counts, if
    that is not the step's start.
    """

    verdict: Verdict
    expected: str
    got: str
    bound_s: float = 0.0
    since_s: float | None = None


class RuleBroken(Exception):
    """A rule of the whole run is broken, during a step or after the last step."""

    def __init__(self, rule: CheckResult) -> None:
        self.rule = rule


def wanted(what: str, within_s: float) -> str:
    """Return the condition for which a step waits, as text: ``ctd.pressure > 3 within 2 s``, or ``... now`` if `within_s`
    is 0.
    """
    return f"{what} within {within_s:g} s" if within_s else f"{what} now"


def too_late(expected: str, got: str, bound_s: float, allowed: Allowance) -> Broken:
    """Return the exception for a missed deadline: INCONCLUSIVE if the host was later than its budget, else FAILED."""
    if allowed.exhausted:
        return Broken(
            Verdict.INCONCLUSIVE, expected, f"{got}; this host itself was late for more than {allowed.any_s:.3f} s"
        )
    if allowed.applies:
        waited = f"; also not in {allowed.any_s:.3f} s more, the lateness of this host" if allowed.any_s else ""
        return Broken(Verdict.FAILED, expected, got + waited)
    return Broken(Verdict.FAILED, expected, got, bound_s)
