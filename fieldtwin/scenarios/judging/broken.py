"""Checks that do not hold: of one step, and of the rules of the whole run."""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.results.model import CheckResult, Verdict
from fieldtwin.scenarios.judging.lateness import Allowance


@dataclass
class Broken(Exception):
    """A check that does not hold: the verdict, the expected and the actual value.

    `bound_s` is the time that it is about, 0 for none; `since_s` is the time from which the host's lateness counts, if
    that is not the step's start.
    """

    verdict: Verdict
    expected: str
    got: str
    bound_s: float = 0.0
    since_s: float | None = None


class RuleBroken(Exception):
    """A rule of the whole run does not hold, during a step or after the last."""

    def __init__(self, rule: CheckResult) -> None:
        self.rule = rule


def wanted(what: str, within_s: float) -> str:
    """Return the condition for which a step waits, as text: ``ctd.pressure > 3 within 2 s``, or ``... now`` if it may take no
    time.
    """
    return f"{what} within {within_s:g} s" if within_s else f"{what} now"


def too_late(expected: str, got: str, bound_s: float, allowed: Allowance) -> Broken:
    """Return the failure of a missed deadline. If the host's lateness has already been waited for, the system has failed."""
    if allowed.exhausted:
        return Broken(
            Verdict.INCONCLUSIVE, expected, f"{got}; this host itself was late for more than {allowed.any_s:.3f} s"
        )
    if allowed.applies:
        waited = f"; also not in {allowed.any_s:.3f} s more, the lateness of this host" if allowed.any_s else ""
        return Broken(Verdict.FAILED, expected, got + waited)
    return Broken(Verdict.FAILED, expected, got, bound_s)
