"""The coverage of Structured Text by scenarios, unit tests and campaigns."""

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
from fieldtwin.console import show_warnings, stdout
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.wallclock import WallClock

if TYPE_CHECKING:
    from fieldtwin.plc.st.coverage.places import Coverage
    from fieldtwin.plc.st.coverage.recording import Recording
    from fieldtwin.plc.st.unit_tests.suite import Suite
    from fieldtwin.reports.campaign.model import CampaignResult


@dataclass(frozen=True)
class CoverageOptions:
    """The file for the coverage, None for none."""

    coverage: Path | None = option(
        "--coverage",
        type=click.Path(dir_okay=False, path_type=Path),
        help="Write the coverage of Structured Text by unit tests and by scenarios in virtual time, also of --seeds: Cobertura "
        "XML, or JSON if the name ends in .json.",
    )

    def wanted(self, *, html: bool) -> bool:
        """Return whether a requested file shows the coverage."""
        return self.coverage is not None or html

    def recording(self, target: str, *, html: bool) -> Recording | None:
        """Return what collects the coverage by scenarios; None outside of virtual time, and if no requested file shows it."""
        from fieldtwin.plc.st.coverage.recording import Recording

        return Recording() if self.wanted(html=html) and target == "virtual" else None

    def write(self, coverage: Coverage | None) -> None:
        """Write the file, if there is one. Raises `UsageError` if nothing in Structured Text was tested."""
        if self.coverage is None:
            return
        if coverage is None:
            raise UsageError(
                "--coverage needs programs in Structured Text",
                expected="unit tests (*.test.st), or scenarios in virtual time, of a system with such a program",
            )
        write_coverage_file(coverage, self.coverage)


def write_measured(coverage: Coverage | None, path: Path) -> None:
    """Write the coverage by a campaign. If none was measured, print a warning, because the other results are valid.

    Raises `FileInvalid` if the file cannot be written.
    """
    if coverage is None:
        needed = "runs with --coverage or --html of a system with a program in Structured Text are needed"
        show_warnings([f"{path} is not written, because no run measured the coverage of Structured Text: {needed}"])
    else:
        write_coverage_file(coverage, path)


def write_coverage_file(coverage: Coverage, path: Path) -> None:
    """Write Cobertura XML, or JSON if the name ends in .json. Raises `FileInvalid` if that is not possible."""
    from fieldtwin.reports.cobertura import write_cobertura
    from fieldtwin.reports.coverage_json import write_coverage

    if path.suffix.lower() == ".json":
        write_coverage(coverage, path)
    else:
        write_cobertura(coverage, path, WallClock().utc_ns() // NS_PER_MS)


def recorded(recording: Recording | None) -> AbstractContextManager[None]:
    """Return the context in which scenarios run."""
    return nullcontext() if recording is None else recording.active()


def coverage_of(
    suites: Iterable[Suite], recording: Recording | None, campaigns: Iterable[CampaignResult] = ()
) -> Coverage | None:
    """Return the coverage by all unit tests, scenarios and campaigns; None if they tested nothing in Structured Text."""
    from fieldtwin.plc.st.coverage.places import Coverage

    found = Coverage()
    for campaign in campaigns:
        if campaign.programs is not None:
            found.add(campaign.programs.executed)
    for suite in suites:
        found.add(suite.coverage())
    if recording is not None:
        found.add(recording.coverage())
    return found if found.executed else None


def show_campaign_coverage(coverage: Coverage | None, counts: Iterable[tuple[int, int]]) -> None:
    """Print the coverage by campaigns, None or empty if nothing was measured. `counts` has, for each campaign, the number of runs
    that measured it, and the number of all its runs; they are printed if only a part of the runs measured it.
    """
    if coverage is not None and coverage.executed:
        show_coverage(coverage, "programs")  # "coverage" is the line about the situations of a campaign
    for measured, runs in counts:
        if 0 < measured < runs:
            stdout.print(f"coverage of Structured Text: measured in {measured} of {runs} runs", soft_wrap=True)


def show_coverage(coverage: Coverage, title: str = "coverage") -> None:
    """Print a line for each file. `title` is the heading of the files."""
    from fieldtwin.plc.st.coverage.places import Kind, line_ranges

    table = Table(box=None, pad_edge=False, show_edge=False, header_style="dim")
    table.add_column(title, overflow="fold")
    for kind in Kind:
        table.add_column(kind.value, justify="right")
    table.add_column("lines not executed", overflow="fold")
    for path in coverage.paths:
        of = coverage.of(path)
        counts = [of.count(kind) for kind in Kind]
        missed = line_ranges(place.line for place in of.missed(Kind.STATEMENT))
        table.add_row(escape(path), *(f"{done}/{every}" if every else "" for done, every in counts), missed)
    stdout.print(table)
