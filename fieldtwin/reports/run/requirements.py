"""The requirement matrix: the scenarios that test each requirement. A requirement is met if all of them passed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from fieldtwin.results.model import Report, Verdict

MOST_COLUMNS = 16
"""Largest number of scenarios that are shown as columns; if there are more, each requirement lists its scenarios."""
MOST_ROWS = 1000
MOST_NAMED = 12
_WORST = (Verdict.FAILED, Verdict.ERROR, Verdict.INCONCLUSIVE, Verdict.SKIPPED, Verdict.PASSED)

Cells = Mapping[tuple[str, str], Counter[Verdict]]


def requirement_verdicts(report: Report) -> dict[str, Verdict | None]:
    """Return every requirement's verdict: the worst verdict of the scenarios that name it, None if no scenario names it."""
    found: dict[str, Verdict | None] = dict.fromkeys(report.requirements)
    for scenario in report.scenarios:
        for id in scenario.requirements:
            known = found.get(id)
            found[id] = scenario.verdict if known is None else _worst([known, scenario.verdict])
    return found


@dataclass(frozen=True)
class Row:
    """A requirement; `verdict` is None if no scenario names it. `cells` have a verdict and a text for each scenario."""

    id: str
    text: str
    verdict: Verdict | None
    cells: list[tuple[Verdict | None, str]]
    listed: str


@dataclass(frozen=True)
class Matrix:
    """The requirements as rows, the scenarios as columns; without columns each row lists its scenarios."""

    met: int
    total: int
    uncovered: int
    columns: list[str]
    rows: list[Row]


def requirement_matrix(report: Report) -> Matrix | None:
    """Return the matrix, or a list if there are many scenarios; None without requirements."""
    verdicts = requirement_verdicts(report)
    if not verdicts:
        return None
    cells: dict[tuple[str, str], Counter[Verdict]] = {}
    for scenario in report.scenarios:
        for id in scenario.requirements:
            cells.setdefault((id, scenario.name), Counter())[scenario.verdict] += 1
    names = list(dict.fromkeys(name for _, name in cells))
    columns = names if len(names) <= MOST_COLUMNS else []
    rows = [
        Row(id, report.requirements.get(id, ""), verdict, [_cell(cells.get((id, name))) for name in columns],
            "" if columns else _listed(id, names, cells))
        for id, verdict in list(verdicts.items())[:MOST_ROWS]
    ]  # fmt: skip
    known = list(verdicts.values())
    return Matrix(known.count(Verdict.PASSED), len(known), known.count(None), columns, rows)


def _listed(id: str, names: list[str], cells: Cells) -> str:
    own = [(name, cells[id, name]) for name in names if (id, name) in cells]
    own.sort(key=lambda item: _WORST.index(_worst(item[1])))
    more = f" and {len(own) - MOST_NAMED} more" if len(own) > MOST_NAMED else ""
    return ", ".join(f"{name} ({_count(count)})" for name, count in own[:MOST_NAMED]) + more


def _cell(count: Counter[Verdict] | None) -> tuple[Verdict | None, str]:
    return (_worst(count), _count(count)) if count else (None, "")


def _count(count: Counter[Verdict]) -> str:
    """Return the worst verdict; with several seeds, also how many have it and how many there are."""
    worst, total = _worst(count), sum(count.values())
    return worst.value if total == 1 else f"{count[worst]} of {total} {worst.value}"


def _worst(verdicts: Counter[Verdict] | list[Verdict]) -> Verdict:
    return next(v for v in _WORST if v in verdicts)
