"""The conformance report of a device as one HTML file: no network, no script, readable on paper.

    write_html(subject, results, reproduce, path)

What failed comes first, with every byte; what passed is a line in the table, its bytes folded away.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from fieldtwin.checking.device_case import DeviceResult, Spoken
from fieldtwin.checking.run import OTHER_WIRE
from fieldtwin.checking.subject import Subject
from fieldtwin.conformance.case import Basis
from fieldtwin.conformance.results import called, summary
from fieldtwin.report.file import put
from fieldtwin.report.html import pill
from fieldtwin.report.markup import Markup, el
from fieldtwin.report.model import Verdict
from fieldtwin.report.style import style
from gateway.core.clock import NS_PER_MS
from gateway.core.connection import Direction

MOST_LINES = 60
"""Of one case's bytes."""
WEIGHT = {
    Basis.STANDARD: "required by the standard",
    Basis.ROBUSTNESS: "robustness: the standard does not require it",
    Basis.FIELD: "known field problem: the standard does not require it",
}
ORDER = (Verdict.ERROR, Verdict.FAILED, Verdict.INCONCLUSIVE, Verdict.PASSED, Verdict.SKIPPED)


def write_html(subject: Subject, results: Sequence[DeviceResult], reproduce: str, path: Path) -> None:
    """Write the report; raises `FileInvalid` where that is not possible."""
    put(path, render_html(subject, results, reproduce))


def render_html(subject: Subject, results: Sequence[DeviceResult], reproduce: str) -> str:
    """The whole page."""
    bad = [r for r in results if r.verdict.bad or r.verdict is Verdict.INCONCLUSIVE]
    bad.sort(key=lambda r: not r.deviates)
    body = [_header(subject, results, reproduce)]
    if bad:
        body += [el("h2", "What was found", id="found"), *(_finding(r) for r in bad)]
    body += [el("h2", "All cases", id="cases"), _table(results)]
    head = el(
        "head",
        el("meta", charset="utf-8"),
        el("meta", name="viewport", content="width=device-width, initial-scale=1"),
        el("title", f"check of {subject.name}"),
        el("style", style()),
    )
    return f"<!doctype html>\n{el('html', head, el('body', el('main', body)), lang='en')}\n"


def overall(results: Sequence[DeviceResult]) -> Verdict:
    """The verdict of the whole check: failed if a required case failed, passed if some case passed and no required one failed."""
    verdicts = {r.verdict for r in results}
    if any(r.deviates or r.verdict is Verdict.ERROR for r in results):
        return Verdict.FAILED
    return Verdict.PASSED if Verdict.PASSED in verdicts else Verdict.INCONCLUSIVE


def _header(subject: Subject, results: Sequence[DeviceResult], reproduce: str) -> Markup:
    facts = [
        ("device", subject.name),
        *subject.identity.items(),
        ("checked", subject.started),
        ("by", f"{subject.by} on {subject.host}" if subject.by else subject.host),
        ("danger", f"up to {subject.at_most}" + (f", writing to {', '.join(subject.wrote)}" if subject.wrote else "")),
        ("reply timeout", f"{subject.timeout_s:g} s"),
        ("fieldtwin", subject.fieldtwin),
    ]
    counts = Counter(_colour(r) for r in results)
    bar = [el("i", cls=v.value, style=f"flex:{counts[v]}") for v in ORDER if counts[v]]
    rows = [[el("dt", name), el("dd", text)] for name, text in facts if text]
    title = el("div", el("h1", f"Conformance of {subject.name}"), el("p", summary(results), cls="small"))
    return el(
        "div",
        el("header", title, pill(overall(results), big=True), cls="top"),
        el("div", bar, cls="bar"),
        el("dl", rows, cls="facts"),
        el("p", "Run again: ", el("code", reproduce), cls="small"),
    )


def _finding(result: DeviceResult) -> Markup:
    case = result.case
    facts = [
        ("source", case.clause),
        ("weight", WEIGHT[case.weighs]),
        ("danger", case.danger.value),
        ("sent", case.does),
        ("expected", case.must),
        ("found", result.reason),
    ]
    quiet = "" if result.deviates else " quiet"
    return el(
        "section",
        el("h3", f"{case.id} {case.title} ", _pill(result)),
        el("dl", [[el("dt", name), el("dd", text)] for name, text in facts], cls="facts"),
        wire_table(result.spoken),
        cls=f"failure{quiet}",
    )


def _pill(result: DeviceResult) -> Markup:
    """The verdict; a failure that is no deviation has the colour of an inconclusive case and its own word."""
    if _colour(result) is result.verdict:
        return pill(result.verdict)
    return el("span", f"! {called(result)}", cls=f"pill {_colour(result).value}")


def _colour(result: DeviceResult) -> Verdict:
    """The verdict whose colour the result has: a failure of a case that the standard does not require is never red."""
    return Verdict.INCONCLUSIVE if result.verdict is Verdict.FAILED and not result.deviates else result.verdict


def wire_table(spoken: Sequence[Spoken]) -> Markup:
    """What was said, line by line."""
    if not spoken:
        return Markup("")
    rows = [
        el(
            "tr",
            el("td", f"{s.t_ns / NS_PER_MS:.1f} ms", cls="num"),
            el("td", "sent" if s.direction is Direction.SENT else "received"),
            el("td", s.text, cls="raw"),
        )
        for s in spoken[:MOST_LINES]
    ]
    more = len(spoken) - MOST_LINES
    table = el("table", rows, cls="frames", style="width:auto")
    return el("div", table, el("p", f"and {more} more", cls="small") if more > 0 else "", cls="wide")


def _table(results: Sequence[DeviceResult]) -> Markup:
    elsewhere = [r for r in results if r.reason == OTHER_WIRE]
    results = [r for r in results if r.reason != OTHER_WIRE]
    columns = ("case", "verdict", "basis", "danger", "sent", "expected", "source", "found")
    head = el("tr", [el("th", name) for name in columns])
    table = el("table", el("thead", head), el("tbody", [_row(r) for r in results]))
    ids = ", ".join(r.case.id for r in elsewhere)
    return el("div", table, el("p", f"For other wires: {ids}.", cls="small") if elsewhere else "", cls="wide")


def _row(result: DeviceResult) -> Markup:
    case = result.case
    said = el("details", el("summary", f"{len(result.spoken)} on the wire"), wire_table(result.spoken))
    return el(
        "tr",
        el("td", f"{case.id} {case.title}", cls="name", id=case.id),
        el("td", _pill(result)),
        el("td", case.weighs.value),
        el("td", case.danger.value),
        el("td", case.does),
        el("td", case.must),
        el("td", case.clause),
        el("td", result.reason, said if result.spoken and not result.verdict.bad else "", cls="long"),
    )
