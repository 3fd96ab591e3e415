"""The part of `fieldtwin test` that checks the programs of the tested systems before the scenarios run."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldtwin.cli.completions import st_warnings
from fieldtwin.cli.option_groups import option
from fieldtwin.console import show_warnings
from fieldtwin.plc.st.dialects import chosen_ids

if TYPE_CHECKING:
    from fieldtwin.cli.plc.checking import Checked
    from fieldtwin.results.model import ScenarioResult
    from fieldtwin.twin.site.system import System

TARGET = "check"
"""The target of the check in reports, where a scenario has virtual, local, compose or real."""
NAME = "check of the programs"


@dataclass(frozen=True)
class FindingOptions:
    """The findings that count as failures, and the file for all of them, None for none."""

    as_errors: tuple[str, ...] = option(
        "--error",
        metavar="ID",
        multiple=True,
        shell_complete=st_warnings,
        help="Fail if a program or its bindings have the finding ID (such as ST105); all for every finding. Can be repeated.",
    )
    findings: Path | None = option(
        "--findings",
        type=click.Path(dir_okay=False, path_type=Path),
        help="Write the findings about the programs to this file, in the JSON form of `fieldtwin plc check`.",
    )

    def check(self, systems: Iterable[System]) -> list[ScenarioResult]:
        """Check the programs of systems, show the findings, and write the file.

        With --error, return the check as a result. Raises `UsageError` for an unknown id.
        """
        from fieldtwin.cli.plc.checking import checked_systems
        from fieldtwin.reports.file import put

        tested = list(systems)
        found = checked_systems(tested, chosen_ids(self.as_errors))
        show_warnings(dict.fromkeys(map(str, found.warnings)))
        if self.findings is not None:
            put(self.findings, json.dumps(found.as_data(), indent=2) + "\n")
        return [_as_result(found, tested[0])] if self.as_errors and tested else []


def _as_result(found: Checked, system: System) -> ScenarioResult:
    from fieldtwin.results.model import CheckResult, ScenarioResult, Verdict

    failed = [
        CheckResult(f"finding {n}", str(error), Verdict.FAILED, where=f"{error.path}:{error.line}")
        for n, error in enumerate(found.errors, 1)
    ]
    waived = [
        CheckResult(f"waived {n}", str(warning), Verdict.SKIPPED, reason=waiver.reason)
        for n, (warning, waiver) in enumerate(found.waived, 1)
    ]
    return ScenarioResult(
        name=NAME,
        verdict=Verdict.FAILED if failed else Verdict.PASSED,
        checks=(*failed, *waived),
        file=system.file.path,
        target=TARGET,
        reason=f"{len(failed)} {'finding' if len(failed) == 1 else 'findings'}" if failed else "",
        reproduce=shlex.join(["fieldtwin", "plc", "check", system.file.path]),
        system=system,
    )
