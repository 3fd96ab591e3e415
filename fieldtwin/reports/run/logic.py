"""The coverage of Structured Text by scenarios and unit tests, as a table of the HTML report."""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.plc.st.coverage.places import Coverage, Kind, line_ranges
from fieldtwin.reports.markup import Markup
from fieldtwin.reports.pages import fill

MOST_FILES = 500
"""Largest number of rows of the table; further files are only counted."""


@dataclass(frozen=True)
class FileRow:
    """A file: for each kind of place, how many were executed and how many there are; and what was not executed."""

    path: str
    counts: dict[Kind, tuple[int, int]]
    lines: str
    branches: str
    transitions: list[str]


def logic_section(coverage: Coverage) -> Markup:
    """Return the section of the report."""
    rows = [_row(path, coverage.of(path)) for path in coverage.paths]
    return fill("logic.html.j2", kinds=list(Kind), rows=rows, MOST_FILES=MOST_FILES)


def _row(path: str, coverage: Coverage) -> FileRow:
    return FileRow(
        path,
        {kind: coverage.count(kind) for kind in Kind},
        line_ranges(place.line for place in coverage.missed(Kind.STATEMENT)),
        ", ".join(f"{place.name} of line {place.line}" for place in coverage.missed(Kind.BRANCH)),
        [place.name for place in coverage.missed(Kind.TRANSITION)],
    )
