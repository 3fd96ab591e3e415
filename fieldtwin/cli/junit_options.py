"""The options for a JUnit file, which all commands that run tests share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import click

from fieldtwin.cli.option_groups import option


@dataclass(frozen=True)
class JunitOptions:
    """The JUnit file of a test, None for none, and its flavour (`fieldtwin.reports.junit.Flavour`)."""

    junit: Path | None = option(
        "--junit", type=click.Path(dir_okay=False, path_type=Path), help="Write the verdicts as JUnit XML."
    )
    junit_flavour: str = option(
        "--junit-flavour",
        type=click.Choice(["common", "jenkins"]),
        default="common",
        show_default=True,
        help="With --junit: jenkins writes only what the schema of Jenkins' xUnit plugin (junit-10.xsd) allows.",
    )
