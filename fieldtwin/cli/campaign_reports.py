"""The options for the reports of a campaign, and their files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldtwin.cli.junit_options import JunitOptions
from fieldtwin.cli.option_groups import option

if TYPE_CHECKING:
    from fieldtwin.reports.campaign.model import CampaignResult


@dataclass(frozen=True)
class CampaignReports(JunitOptions):
    """The JUnit file and the HTML page of a campaign, None for none."""

    html: Path | None = option(
        "--html",
        type=click.Path(dir_okay=False, path_type=Path),
        help="Write an HTML page with failures by cause, runs over time, and workers to this file.",
    )

    @property
    def given(self) -> str:
        """Return the first of these options that was given, empty if none was."""
        return "--junit" if self.junit is not None else "--html" if self.html is not None else ""

    def write(self, campaigns: Sequence[CampaignResult]) -> None:
        """Write the files. Raises `FileInvalid` if that is not possible."""
        if self.junit is not None:
            from fieldtwin.reports.junit import Flavour, write_junit
            from fieldtwin.run.campaigns.reporting import junit_report

            write_junit(junit_report(campaigns), self.junit, Flavour(self.junit_flavour))
        if self.html is not None:
            from fieldtwin.reports.campaign.html import write_campaign

            write_campaign(campaigns, self.html)
