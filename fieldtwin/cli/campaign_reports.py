"""The options for the reports of a campaign, and their files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldtwin.cli.campaigns.st_coverage import coverage_of, write_measured
from fieldtwin.cli.junit_options import JunitOptions
from fieldtwin.cli.option_groups import option

if TYPE_CHECKING:
    from fieldtwin.reports.campaign.model import CampaignResult


@dataclass(frozen=True)
class CampaignReports(JunitOptions):
    """The JUnit file, the HTML page, and the file for the coverage of Structured Text of a campaign, None for none."""

    html: Path | None = option(
        "--html",
        type=click.Path(dir_okay=False, path_type=Path),
        help="Write an HTML page with failures by cause, runs over time, and workers to this file.",
    )

    coverage: Path | None = option(
        "--coverage",
        type=click.Path(dir_okay=False, path_type=Path),
        help="Write the coverage of Structured Text by all seeds: Cobertura XML, or JSON if the name ends in .json.",
    )

    @property
    def measures(self) -> bool:
        """Return whether a requested file shows the coverage of Structured Text."""
        return self.coverage is not None or self.html is not None

    @property
    def given(self) -> str:
        """Return the first of these options that was given, empty if none was."""
        files = {"--junit": self.junit, "--html": self.html, "--coverage": self.coverage}
        return next((option for option, path in files.items() if path is not None), "")

    def write(self, campaigns: Sequence[CampaignResult]) -> None:
        """Write the files. Raises `FileInvalid` if that is not possible."""
        if self.junit is not None:
            from fieldtwin.reports.junit import Flavour, write_junit
            from fieldtwin.run.campaigns.reporting import junit_report

            write_junit(junit_report(campaigns), self.junit, Flavour(self.junit_flavour))
        if self.html is not None:
            from fieldtwin.reports.campaign.html import write_campaign

            write_campaign(campaigns, self.html)
        if self.coverage is not None:
            write_measured(coverage_of((), None, campaigns), self.coverage)
