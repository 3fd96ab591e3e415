"""The conformance report of a master as one HTML file: no network, no script, readable on paper.

Failed and open cases come first, with their frames. All cases follow in a table; the frames of passed ones are folded away.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from fieldtwin.__about__ import __version__
from fieldtwin.conformance.core.evidence import Line, reproduce
from fieldtwin.conformance.core.results import CaseResult, summary
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

OPEN_LINES = 24
"""Lines of a case's frames that are shown without a click."""


def write_master_html(results: Sequence[CaseResult], title: str, argv: Sequence[str], started: str, path: Path) -> None:
    """Write the report; raises `FileInvalid` where that is not possible."""
    put(path, render_master_html(results, title, argv, started))


def render_master_html(results: Sequence[CaseResult], title: str, argv: Sequence[str], started: str) -> str:
    """Return the whole page. Each failed or open case comes with its frames and the command that repeats it."""
    bad = by_weight([r for r in results if r.verdict.bad or r.verdict is Verdict.INCONCLUSIVE])
    heading = el("div", el("h1", f"Conformance of {title}"), el("p", summary(results), cls="small"))
    facts = [("checked", started), ("fieldtwin", __version__)]
    body = [
        el("header", heading, pill(overall(results), big=True), cls="top"),
        verdict_bar(results),
        el("dl", [[el("dt", name), el("dd", text)] for name, text in facts], cls="facts"),
        el("p", "Run again: ", el("code", shlex.join(["fieldtwin", *argv])), cls="small"),
    ]
    if bad:
        body += [el("h2", "What was found", id="found"), *(_finding(r, argv) for r in bad)]
    body += [
        el("h2", "All cases", id="cases"),
        case_table(results, "the device", _folded_frames),
        sources_note(results),
    ]
    return page(f"check of {title}", style(), body)


def _finding(result: CaseResult, argv: Sequence[str]) -> Markup:
    case = result.case
    facts = [("source", case.clause), ("basis", BASIS[case.basis]), ("danger", case.danger.value), ("the device", case.does),
             ("expected", case.must), ("found", result.reason)]  # fmt: skip
    return el(
        "section",
        el("h3", f"{case.id} {case.title} ", verdict_pill(result)),
        el("dl", [[el("dt", name), el("dd", text)] for name, text in facts if text], cls="facts"),
        _frames(result.wire),
        el("p", "Run again: ", el("code", reproduce(argv, case.id)), cls="small"),
        cls="failure" if result.deviates else "failure quiet",
    )


def _frames(wire: Sequence[Line]) -> Markup:
    """Return the first lines, with the others folded away: an error is usually close to the first faulty answer."""
    if not wire:
        return Markup("")
    more = wire[OPEN_LINES:]
    folded = el("details", el("summary", f"{len(more)} more lines"), _lines(more)) if more else ""
    return el("div", _lines(wire[:OPEN_LINES]), folded, cls="wide")


def _lines(wire: Sequence[Line]) -> Markup:
    rows = [
        el("tr", el("td", f"{w.t_ms:.1f} ms", cls="num"), el("td", w.by), el("td", w.data, cls="raw"), el("td", w.text))
        for w in wire
    ]
    return el("table", rows, cls="frames", style="width:auto")


def _folded_frames(result: CaseResult) -> Markup | str:
    if not result.wire or result.verdict is not Verdict.PASSED:
        return ""
    return el("details", el("summary", f"{len(result.wire)} on the wire"), _frames(result.wire))
