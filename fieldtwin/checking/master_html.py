"""The conformance report of a master as one HTML file: no network, no script, readable on paper."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from fieldtwin.conformance.evidence import reproduce
from fieldtwin.conformance.results import CaseResult, summary
from fieldtwin.report.file import put
from fieldtwin.report.html import pill
from fieldtwin.report.markup import Markup, el
from fieldtwin.report.model import Verdict
from fieldtwin.report.style import style

ORDER = (Verdict.ERROR, Verdict.FAILED, Verdict.INCONCLUSIVE, Verdict.PASSED, Verdict.SKIPPED)


def write_master_html(results: Sequence[CaseResult], title: str, argv: Sequence[str], started: str, path: Path) -> None:
    """Write the report; raises `FileInvalid` where that is not possible."""
    put(path, render_master_html(results, title, argv, started))


def render_master_html(results: Sequence[CaseResult], title: str, argv: Sequence[str], started: str) -> str:
    """The whole page: each case with its verdict, its frames, and the command that plays it again. Failures come first."""
    ordered = sorted(results, key=lambda r: ORDER.index(r.verdict))
    body = [
        el("header", el("div", el("h1", f"Conformance of {title}"), el("p", summary(results), cls="small")), cls="top"),
        el("p", started, cls="small"),
        el("p", "Run again: ", el("code", shlex.join(["fieldtwin", *argv])), cls="small"),
        *(_case(r, argv) for r in ordered),
    ]
    head = el("head", el("meta", charset="utf-8"), el("title", f"check of {title}"), el("style", style()))
    return f"<!doctype html>\n{el('html', head, el('body', el('main', body)), lang='en')}\n"


def _case(result: CaseResult, argv: Sequence[str]) -> Markup:
    case = result.case
    facts = [("source", case.clause), ("danger", case.danger.value), ("the device", case.does), ("expected", case.must),
             ("found", result.reason)]  # fmt: skip
    rows = [
        el("tr", el("td", f"{w.t_ms:.1f} ms", cls="num"), el("td", w.by), el("td", w.data, cls="raw"), el("td", w.text))
        for w in result.wire
    ]
    return el(
        "section",
        el("h3", f"{case.id} {case.title} ", pill(result.verdict)),
        el("dl", [[el("dt", name), el("dd", text)] for name, text in facts if text], cls="facts"),
        el("div", el("table", rows, cls="frames", style="width:auto"), cls="wide") if rows else "",
        el("p", "Run again: ", el("code", reproduce(argv, case.id)), cls="small"),
        cls="failure" if result.verdict.bad else "failure quiet",
    )
