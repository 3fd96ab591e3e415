"""The requirement matrix: the scenarios that test each requirement. A requirement is met if all of them passed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from fieldtwin.reports.markup import Markup, el, join
from fieldtwin.results.model import Report, Verdict

MOST_COLUMNS = 16
"""Largest number of scenarios as columns; if there are more, each requirement lists its own."""
MOST_ROWS = 1000
MOST_NAMED = 12
_WORST = (Verdict.FAILED, Verdict.ERROR, Verdict.INCONCLUSIVE, Verdict.SKIPPED, Verdict.PASSED)

Cells = Mapping[tuple[str, str], Counter[Verdict]]


def requirement_verdicts(report: Report) -> dict[str, Verdict | None]:
    """Return every requirement's verdict: the worst of the scenarios that name it, None if none does."""
    found: dict[str, Verdict | None] = dict.fromkeys(report.requirements)
    for scenario in report.scenarios:
        for id in scenario.requirements:
            known = found.get(id)
            found[id] = scenario.verdict if known is None else _worst([known, scenario.verdict])
    return found


def requirement_section(report: Report) -> Markup:
    """Return the matrix, or a list if there are many scenarios."""
    verdicts = requirement_verdicts(report)
    if not verdicts:
        return el("p", "No scenario names a requirement, and none is to be covered.")
    cells: dict[tuple[str, str], Counter[Verdict]] = {}
    for scenario in report.scenarios:
        for id in scenario.requirements:
            cells.setdefault((id, scenario.name), Counter())[scenario.verdict] += 1
    names = list(dict.fromkeys(name for _, name in cells))
    uncovered = [id for id, verdict in verdicts.items() if verdict is None]
    met = sum(v is Verdict.PASSED for v in verdicts.values())
    said = f"{met} of {len(verdicts)} met" + (f", {len(uncovered)} covered by no scenario" if uncovered else "")
    matrix = len(names) <= MOST_COLUMNS
    rows = [
        _row(report, id, verdict, cells, names, matrix=matrix) for id, verdict in list(verdicts.items())[:MOST_ROWS]
    ]
    columns = [el("th", n, cls="tilt") for n in names] if matrix else [el("th", "scenarios")]
    head = el("tr", el("th", "requirement", colspan=2), el("th", "verdict"), columns)
    more = len(verdicts) - MOST_ROWS
    return join(
        [
            el("p", said, cls="small"),
            el("div", el("table", el("thead", head), el("tbody", rows), cls="grid matrix"), cls="wide"),
            el("p", f"and {more} more", cls="small") if more > 0 else "",
        ]
    )


def _row(report: Report, id: str, verdict: Verdict | None, cells: Cells, names: list[str], *, matrix: bool) -> Markup:
    if verdict is None:
        word = el("td", "not covered", cls="missing")
    else:
        word = el("td", verdict.value, cls=verdict.value)
    text = el("td", report.requirements.get(id, ""), cls="left")
    head = [el("th", id, scope="row"), text, word]
    if matrix:
        return el("tr", head, [_cell(cells.get((id, name))) for name in names])
    own = [(name, cells[id, name]) for name in names if (id, name) in cells]
    own.sort(key=lambda item: _WORST.index(_worst(item[1])))
    listed = ", ".join(f"{name} ({_count(count)})" for name, count in own[:MOST_NAMED])
    more = f" and {len(own) - MOST_NAMED} more" if len(own) > MOST_NAMED else ""
    return el("tr", head, el("td", listed + more, cls="left"))


def _cell(count: Counter[Verdict] | None) -> Markup:
    if not count:
        return el("td", "")
    return el("td", _count(count), cls=_worst(count).value)


def _count(count: Counter[Verdict]) -> str:
    """Return the worst verdict; with several seeds, also how many have it and how many there are."""
    worst, total = _worst(count), sum(count.values())
    return worst.value if total == 1 else f"{count[worst]} of {total} {worst.value}"


def _worst(verdicts: Counter[Verdict] | list[Verdict]) -> Verdict:
    return next(v for v in _WORST if v in verdicts)
