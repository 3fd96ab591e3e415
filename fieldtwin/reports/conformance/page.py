"""The conformance report as one HTML file, for devices and clients: no network, no script, readable on paper.

Failed and open cases come first, with their frames. A table of all cases follows, in which the frames of the other cases are
collapsed. The page's text is in templates/conformance.html.j2.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import TypeVar

from fieldtwin.book import case_url
from fieldtwin.conformance.core.case import OTHER_WIRE, Basis
from fieldtwin.conformance.core.evidence import Line
from fieldtwin.conformance.core.results import ONLY_REQUIRED, CaseResult, called, counts_as_failed, summary
from fieldtwin.reports.pages import fill
from fieldtwin.results.model import Verdict

OPEN_LINES = 24
"""Number of lines of a case's frames that are shown without a click."""
BASIS = {
    Basis.STANDARD: "required by the standard",
    Basis.ROBUSTNESS: "robustness: the standard does not require it",
    Basis.FIELD: "known field problem: the standard does not require it",
}
MODBUS_SOURCES = (
    "SL: MODBUS over Serial Line V1.02. TG: MODBUS Messaging on TCP/IP Implementation Guide V1.0b. AP: MODBUS Application "
    "Protocol V1.1b3."
)
CANOPEN_SOURCES = "A number alone is a clause of CiA 301 v4.2.0. CN: CANopenNode. py: canopen for Python."
ALL_SOURCES = (
    "A name with a number is an issue or pull request (PR) of that project (HA: Home Assistant). fieldtwin: neither a clause nor "
    "a report of another project."
)
ORDER = (Verdict.ERROR, Verdict.FAILED, Verdict.INCONCLUSIVE, Verdict.PASSED, Verdict.SKIPPED)
R = TypeVar("R", bound=CaseResult)


def render_page(
    name: str,
    results: Sequence[R],
    facts: Sequence[tuple[str, str]],
    again: str,
    *,
    does: str,
    frames_of: Callable[[R], Sequence[Line]],
    repeat: Callable[[str], str],
    fail_on: frozenset[Basis] = ONLY_REQUIRED,
) -> str:
    """Return the whole page about `name`.

    `again` is the command that repeats all cases, and `repeat` returns the one for a case's id. `does` is the heading of the
    actions in a case. `fail_on` are the bases whose failed cases make the headline failed.
    """
    found = sorted(
        (r for r in results if r.verdict.bad or r.verdict is Verdict.INCONCLUSIVE),
        key=lambda r: (ORDER.index(r.verdict), not r.deviates),
    )
    counts = Counter(colour_of(r) for r in results)
    sources = CANOPEN_SOURCES if any(r.case.id.startswith("CO-") for r in results) else MODBUS_SOURCES
    return fill(
        "conformance.html.j2",
        name=name,
        summary=summary(results),
        overall=overall(results, fail_on),
        counts={verdict: counts[verdict] for verdict in ORDER},
        facts=facts,
        again=again,
        repeat=repeat,
        found=found,
        found_ids={r.case.id for r in found},
        results=[r for r in results if r.reason != OTHER_WIRE],
        elsewhere=", ".join(r.case.id for r in results if r.reason == OTHER_WIRE),
        does=does,
        frames_of=frames_of,
        colour_of=colour_of,
        called=called,
        sources=f"{sources} {ALL_SOURCES}",
        url_of=case_url,
        BASIS=BASIS,
        OPEN_LINES=OPEN_LINES,
    )


def overall(results: Sequence[CaseResult], fail_on: frozenset[Basis] = ONLY_REQUIRED) -> Verdict:
    """Return the verdict on all cases, which agrees with the exit code of `fieldtwin check`.

    It is failed if a case failed whose basis is one of `fail_on`, else passed if a case passed, and else inconclusive.
    """
    verdicts = {r.verdict for r in results}
    if any(counts_as_failed(r, fail_on) for r in results):
        return Verdict.FAILED
    return Verdict.PASSED if Verdict.PASSED in verdicts else Verdict.INCONCLUSIVE


def colour_of(result: CaseResult) -> Verdict:
    """Return the verdict whose colour the result has: a failure of a case that the standard does not require is never red."""
    return Verdict.INCONCLUSIVE if result.verdict is Verdict.FAILED and not result.deviates else result.verdict
