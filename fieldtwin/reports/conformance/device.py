"""The conformance report of a device as one HTML file: no network, no script, readable on paper.

    write_html(subject, results, reproduce, path)

Failed cases come first, with every byte; a passed case is a line in the table, with its bytes folded away.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fieldtwin.conformance.core.results import summary
from fieldtwin.conformance.devices.device_case import DeviceResult, Spoken
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.reports.conformance.verdicts import (
    BASIS,
    by_weight,
    case_table,
    overall,
    sources_note,
    verdict_bar,
    verdict_pill,
)
from fieldtwin.reports.file import put
from fieldtwin.reports.markup import Markup, el, page
from fieldtwin.reports.run.html import pill
from fieldtwin.reports.style import style
from fieldtwin.results.model import Verdict
from fieldtwin.results.subject import Subject

MOST_LINES = 60
"""Maximum number of lines of one case's bytes."""


def write_html(subject: Subject, results: Sequence[DeviceResult], reproduce: str, path: Path) -> None:
    """Write the report; raises `FileInvalid` where that is not possible."""
    put(path, render_html(subject, results, reproduce))


def render_html(subject: Subject, results: Sequence[DeviceResult], reproduce: str) -> str:
    """Return the whole page."""
    bad = by_weight([r for r in results if r.verdict.bad or r.verdict is Verdict.INCONCLUSIVE])
    body = [_header(subject, results, reproduce)]
    if bad:
        body += [el("h2", "What was found", id="found"), *(_finding(r) for r in bad)]
    body += [el("h2", "All cases", id="cases"), case_table(results, "sent", _folded_bytes), sources_note(results)]
    return page(f"check of {subject.name}", style(), body)


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
    rows = [[el("dt", name), el("dd", text)] for name, text in facts if text]
    title = el("div", el("h1", f"Conformance of {subject.name}"), el("p", summary(results), cls="small"))
    return el(
        "div",
        el("header", title, pill(overall(results), big=True), cls="top"),
        verdict_bar(results),
        el("dl", rows, cls="facts"),
        el("p", "Run again: ", el("code", reproduce), cls="small"),
    )


def _finding(result: DeviceResult) -> Markup:
    case = result.case
    facts = [
        ("source", case.clause),
        ("basis", BASIS[case.basis]),
        ("danger", case.danger.value),
        ("sent", case.does),
        ("expected", case.must),
        ("found", result.reason),
    ]
    quiet = "" if result.deviates else " quiet"
    return el(
        "section",
        el("h3", f"{case.id} {case.title} ", verdict_pill(result)),
        el("dl", [[el("dt", name), el("dd", text)] for name, text in facts], cls="facts"),
        wire_table(result.spoken),
        cls=f"failure{quiet}",
    )


def wire_table(spoken: Sequence[Spoken]) -> Markup:
    """Return a table of the frames, one per row."""
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


def _folded_bytes(result: DeviceResult) -> Markup | str:
    if not result.spoken or result.verdict.bad:
        return ""
    return el("details", el("summary", f"{len(result.spoken)} on the wire"), wire_table(result.spoken))
