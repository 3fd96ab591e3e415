"""Verdicts, bases and counts of a conformance report in HTML, for devices and masters alike."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import TypeVar

from fieldtwin.conformance.core.case import OTHER_WIRE, Basis
from fieldtwin.conformance.core.results import CaseResult, called
from fieldtwin.reports.markup import Markup, el
from fieldtwin.reports.run.html import pill
from fieldtwin.results.model import Verdict

R = TypeVar("R", bound=CaseResult)
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


def overall(results: Sequence[CaseResult]) -> Verdict:
    """Return the verdict of the check: failed if a required case failed, passed if a case passed and no required one failed."""
    verdicts = {r.verdict for r in results}
    if any(r.deviates or r.verdict is Verdict.ERROR for r in results):
        return Verdict.FAILED
    return Verdict.PASSED if Verdict.PASSED in verdicts else Verdict.INCONCLUSIVE


def colour_of(result: CaseResult) -> Verdict:
    """Return the verdict whose colour the result has: a failure of a case that the standard does not require is never red."""
    return Verdict.INCONCLUSIVE if result.verdict is Verdict.FAILED and not result.deviates else result.verdict


def verdict_pill(result: CaseResult) -> Markup:
    """Return the verdict as a label.

    A failure that does not deviate from a standard has the colour of an inconclusive case and its own word.
    """
    if colour_of(result) is result.verdict:
        return pill(result.verdict)
    return el("span", f"! {called(result)}", cls=f"pill {colour_of(result).value}")


def verdict_bar(results: Sequence[CaseResult]) -> Markup:
    """Return the number of cases of each colour as a bar."""
    counts = Counter(colour_of(r) for r in results)
    return el("div", [el("i", cls=v.value, style=f"flex:{counts[v]}") for v in ORDER if counts[v]], cls="bar")


def sources_note(results: Sequence[CaseResult]) -> Markup:
    """Return a note that explains the sources of the cases."""
    canopen = any(r.case.id.startswith("CO-") for r in results)
    return el("p", f"Sources. {CANOPEN_SOURCES if canopen else MODBUS_SOURCES} {ALL_SOURCES}", cls="small")


def by_weight(results: Sequence[R]) -> list[R]:
    """Sort the results: deviations first, then other failures, inconclusive, passed and skipped cases."""
    return sorted(results, key=lambda r: (ORDER.index(r.verdict), not r.deviates))


def case_table(results: Sequence[R], does: str, folded: Callable[[R], Markup | str]) -> Markup:
    """Return the table of all cases; cases for other transports are only named below it.

    `does` is the heading of the device's actions in a case, and `folded` returns the text after the reason in its last
    column.
    """
    elsewhere = [r for r in results if r.reason == OTHER_WIRE]
    columns = ("case", "verdict", "basis", "danger", does, "expected", "source", "found")
    rows = [_case_row(r, folded(r)) for r in results if r.reason != OTHER_WIRE]
    table = el("table", el("thead", el("tr", [el("th", name) for name in columns])), el("tbody", rows))
    ids = ", ".join(r.case.id for r in elsewhere)
    return el("div", table, el("p", f"For other wires: {ids}.", cls="small") if ids else "", cls="wide")


def _case_row(result: CaseResult, folded: Markup | str) -> Markup:
    case = result.case
    return el(
        "tr",
        el("td", f"{case.id} {case.title}", cls="name", id=case.id),
        el("td", verdict_pill(result)),
        el("td", case.basis.value),
        el("td", case.danger.value),
        el("td", case.does),
        el("td", case.must),
        el("td", case.clause),
        el("td", result.reason, folded, cls="long"),
    )
