"""The coverage of Structured Text by the scenarios and unit tests of `fieldtwin test`."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.markup import escape
from rich.table import Table

from fieldtwin.cli.option_groups import option
from fieldtwin.console import stdout
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.wallclock import WallClock

if TYPE_CHECKING:
    from fieldtwin.plc.st.coverage.places import Coverage
    from fieldtwin.plc.st.coverage.recording import Recording
    from fieldtwin.plc.st.unit_tests.suite import Suite


@dataclass(frozen=True)
class CoverageOptions:
    """The file for the coverage, None for none."""

    coverage: Path | None = option(
        "--coverage",
        type=click.Path(dir_okay=False, path_type=Path),
        help="Write the coverage of Structured Text by unit tests and by scenarios in virtual time: Cobertura XML, or JSON if "
        "the name ends in .json.",
    )

    def recording(self, target: str, *, campaign: bool, html: bool) -> Recording | None:
        """Return what collects the coverage by scenarios; None outside of virtual time, and if no requested file shows it."""
        from fieldtwin.plc.st.coverage.recording import Recording

        wanted = self.coverage is not None or html
        return Recording() if wanted and target == "virtual" and not campaign else None

    def write(self, coverage: Coverage | None) -> None:
        """Write the file, if there is one. Raises `UsageError` if nothing in Structured Text was tested."""
        if self.coverage is None:
            return
        if coverage is None:
            raise UsageError(
                "--coverage needs programs in Structured Text",
                expected="unit tests (*.test.st), or scenarios in virtual time without --seeds, of a system with such a program",
            )
        from fieldtwin.reports.cobertura import write_cobertura
        from fieldtwin.reports.coverage_json import write_coverage

        if self.coverage.suffix.lower() == ".json":
            write_coverage(coverage, self.coverage)
        else:
            write_cobertura(coverage, self.coverage, WallClock().utc_ns() // NS_PER_MS)


def recorded(recording: Recording | None) -> AbstractContextManager[None]:
    """Return the context in which scenarios run."""
    return nullcontext() if recording is None else recording.active()


def coverage_of(suites: Iterable[Suite], recording: Recording | None) -> Coverage | None:
    """Return the coverage by all unit tests and scenarios; None if they tested nothing in Structured Text."""
    from fieldtwin.plc.st.coverage.places import Coverage

    found = Coverage()
    for suite in suites:
        found.add(suite.coverage())
    if recording is not None:
        found.add(recording.coverage())
    return found if found.executed else None


def show_coverage(coverage: Coverage) -> None:
    """Print a line for each file."""
    from fieldtwin.plc.st.coverage.places import Kind, line_ranges

    table = Table(box=None, pad_edge=False, show_edge=False, header_style="dim")
    table.add_column("coverage", overflow="fold")
    for kind in Kind:
        table.add_column(kind.value, justify="right")
    table.add_column("lines not executed", overflow="fold")
    for path in coverage.paths:
        of = coverage.of(path)
        counts = [of.count(kind) for kind in Kind]
        missed = line_ranges(place.line for place in of.missed(Kind.STATEMENT))
        table.add_row(escape(path), *(f"{done}/{every}" if every else "" for done, every in counts), missed)
    stdout.print(table)
