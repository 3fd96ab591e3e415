"""The options that all commands of `fieldtwin check` have, for devices and for masters, and the use of their values."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fieldtwin.cli.junit_options import JunitOptions
from fieldtwin.cli.option_groups import option
from fieldtwin.cli.options import JSON, Duration
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.nearest import nearest

if TYPE_CHECKING:
    from fieldtwin.conformance.core.case import About, Basis
    from fieldtwin.conformance.core.results import CaseResult
    from fieldtwin.conformance.core.waivers import Waivers
    from fieldtwin.results.model import Report

IMPACTS = ("observe", "read", "write", "disrupt")
"""The values of `Impact`, in rising order."""
FAIL_ON = {"standard": 1, "robustness": 2, "field": 3}
"""The values of --fail-on. Each maps to a number n: failures of the first n members of `Basis` decide the exit code."""
_FILE = click.Path(dir_okay=False, path_type=Path)
_ID = re.compile(r"^((?:MB|CO)-)?(\d{1,3})([a-h]?)$", re.IGNORECASE)


@dataclass(frozen=True)
class CaseOptions:
    """The options that choose test cases, and the failures that affect the exit code."""

    only: str | None = option(
        "--only", metavar="IDS", help="Run only these test cases or rows, separated by commas: MB-013,MB-015a."
    )
    for_s: float = option(
        "--for", type=Duration(), default="0", help="Begin no test case after this time.  [default: no limit]"
    )
    waivers_path: Path | None = option(
        "--waivers", type=click.Path(path_type=Path), help="YAML file of accepted failures: id, owner, reason, expires."
    )
    fail_on: str = option(
        "--fail-on",
        type=click.Choice(tuple(FAIL_ON)),
        default="standard",
        show_default=True,
        help="Failed cases that cause exit code 1: those required by the standard, also robustness, or also known field "
        "problems.",
    )

    def chosen(self, cases: Sequence[About]) -> frozenset[str]:
        """Return the IDs of `--only`, such as ``MB-013,15a``. An unknown one is a `UsageError` with the nearest match."""
        chosen = set()
        known = {case.id for case in cases} | {case.row for case in cases}
        prefix = cases[0].id[:3]
        for part in filter(None, map(str.strip, (self.only or "").split(","))):
            match = _ID.match(part)
            id = f"{(match[1] or prefix).upper()}{int(match[2]):03}{match[3].lower()}" if match else part
            if id not in known:
                near = nearest(id, known)
                raise UsageError(f"no case {part!r}", expected=near[0] if near else "an id such as " + cases[0].id)
            chosen.add(id)
        return frozenset(chosen)

    def waivers(self, cases: Sequence[About]) -> Waivers:
        """Return the accepted failures. Raises `FileInvalid`, also for the ID of an unknown case."""
        from fieldtwin.conformance.core.waivers import Waivers, load_waivers

        known = {case.id for case in cases} | {case.row for case in cases}
        return load_waivers(self.waivers_path, known) if self.waivers_path else Waivers()

    @property
    def bases(self) -> frozenset[Basis]:
        """Return the bases whose failed cases decide the exit code."""
        from fieldtwin.conformance.core.case import Basis

        return frozenset(list(Basis)[: FAIL_ON[self.fail_on]])


@dataclass(frozen=True)
class ResultOptions(JunitOptions):
    """The output of a conformance test."""

    html: Path | None = option("--html", type=_FILE, help="Write a report with every frame.")
    out: Path | None = option(
        "-o", "--out", type=_FILE, help="Write the JSON to a file; that of a device is for `fieldtwin report`."
    )
    log_path: Path | None = option("--log", type=_FILE, help="Append all sent and received frames, as JSON lines.")
    list_only: bool = option("--list", is_flag=True, help="List the test cases with their basis, and exit.")
    as_json: bool = option("--json", **JSON)

    def list_cases(self, cases: Sequence[About]) -> int:
        """Print the test cases, and return the exit code."""
        from fieldtwin.cli.test.check_view import listed, print_cases

        if self.as_json:
            json.dump([listed(case) for case in cases], sys.stdout, indent=2)
            sys.stdout.write("\n")
        else:
            print_cases(cases)
        return 0

    def conclude(
        self,
        results: Sequence[CaseResult],
        document: Mapping[str, Any],
        report: Report,
        write_html: Callable[[Path], None],
        choice: CaseOptions,
    ) -> int:
        """Write the files, show the results, and return the exit code. Raises `FileInvalid` if a file cannot be written."""
        from fieldtwin.cli.test.check_view import print_not_counted, print_results
        from fieldtwin.conformance.core.results import exit_code
        from fieldtwin.reports.file import put
        from fieldtwin.reports.junit import Flavour, write_junit

        text = json.dumps(document, indent=2) + "\n"
        if self.out is not None:
            put(self.out, text)
        if self.junit is not None:
            write_junit(report, self.junit, Flavour(self.junit_flavour))
        if self.html is not None:
            write_html(self.html)
        if self.as_json:
            sys.stdout.write(text)
        else:
            print_results(results, all_wires=bool(choice.only))
            print_not_counted(results, choice.bases)
        return exit_code(results, choice.bases)
