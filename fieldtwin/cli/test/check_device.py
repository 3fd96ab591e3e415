"""Shared parts of `fieldtwin check modbus` and `check canopen`: options, confirmation, progress bar, output files."""

from __future__ import annotations

import asyncio
import shlex
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import click

from fieldtwin.cli.option_groups import option
from fieldtwin.cli.test.check_options import IMPACTS, CaseOptions, ResultOptions
from fieldtwin.gateway.core.errors import NotAllowed, UsageError

if TYPE_CHECKING:
    from fieldtwin.conformance.core.case import CasePlan
    from fieldtwin.conformance.devices.checked import Checked
    from fieldtwin.conformance.devices.device_case import DeviceCase, DeviceResult
    from fieldtwin.results.subject import Subject

_WRITES = "writes, also invalid ones; the values of --write are restored"
MEANS = {
    "modbus": {
        "write": _WRITES,
        "disrupt": "unknown functions, long frames, FC 08, many connections: the device or others may stop answering",
    },
    "canopen": {
        "write": _WRITES,
        "disrupt": "NMT, guarding, LSS, unknown commands: the node is stopped and restarted",
    },
}
INTERRUPTED = 130


@dataclass(frozen=True)
class CareOptions:
    """The options that limit a check of a device, and the name of the tester."""

    allow: str | None = option(
        "--allow", type=click.Choice(IMPACTS), help="Highest impact level to run.  [default: read; write with --write]"
    )
    yes: bool = option("--yes", is_flag=True, help="Do not ask before cases that write or disrupt.")
    i_know: bool = option(
        "--i-know", is_flag=True, help="Also run cases that reach every device on the line, or restart this one."
    )
    dry_run: bool = option("--dry-run", is_flag=True, help="Show the frames that would be sent; send nothing.")
    rate: float = option(
        "--rate",
        type=click.FloatRange(0.1, 10_000),
        default=20.0,
        show_default=True,
        help="Maximum requests per second.",
    )
    by: str | None = option("--by", help="Name of the tester, for the reports.  [default: your login name]")


class DeviceCheck:
    """The common parts of `check modbus` and `check canopen`: the plan, the confirmation, the files."""

    def __init__(
        self, protocol: str, endpoint: str, address: int, care: CareOptions, choice: CaseOptions, files: ResultOptions
    ) -> None:
        self.protocol, self.endpoint, self.address = protocol, endpoint, address
        self.care, self.choice, self.files = care, choice, files
        self.words = "fieldtwin " + shlex.join(sys.argv[1:])
        self.interrupted = False

    def plan(self, cases: Sequence[DeviceCase[Any]], has: set[str], writes: bool) -> CasePlan:
        """Return the plan. Also read the waivers, so that an invalid file is reported before anything is sent."""
        from fieldtwin.conformance.core.case import CasePlan, Impact

        self.waivers = self.choice.waivers(cases)
        allow = self.care.allow or ("write" if writes else "read")
        if writes and Impact(allow).rank < Impact.WRITE.rank:
            raise UsageError("--write needs test cases that write", expected="--allow write or disrupt", got=allow)
        if self.care.i_know:
            has = has | {"i-know"}
        return CasePlan(self.choice.chosen(cases), Impact(allow), frozenset(has), self.choice.for_s)

    def ask(self, cases: Sequence[DeviceCase[Any]], plan: CasePlan, traits: frozenset[str]) -> None:
        """Ask before anything except reading is sent. Raises `NotAllowed` without a terminal, `Abort` if the answer is no."""
        from fieldtwin.conformance.core.case import Impact
        from fieldtwin.conformance.devices.run import why_not
        from fieldtwin.console import stderr

        played = [c for c in cases if c.chosen(plan.only) and not why_not(c, plan, traits)]
        risky = [c for c in played if c.impact.rank > Impact.READ.rank]
        if not risky or self.care.yes:
            return
        for impact, means in MEANS[self.protocol].items():
            ids = [c.id for c in risky if c.impact.value == impact]
            if ids:
                stderr.print(
                    f"{len(ids)} test cases with impact level {impact}: {means}.\n  {', '.join(ids)}", markup=False
                )
        if not sys.stdin.isatty():
            raise NotAllowed(
                "test cases that do more than read need a confirmation", expected="--yes, or a terminal to ask on"
            )
        click.confirm("Play them?", abort=True, err=True)

    def done(self, subject: Subject, checked: Checked) -> int:
        """Apply the waivers, write the files, show the table, and return the exit code."""
        from fieldtwin.conformance.core.results import waive
        from fieldtwin.conformance.devices.results import as_json, as_report
        from fieldtwin.reports.conformance.device import write_html

        fail_on = self.choice.bases
        today = datetime.fromisoformat(subject.started).date()
        results: list[DeviceResult] = [waive(result, self.waivers, today) for result in checked.results]
        code = self.files.conclude(
            results,
            as_json(subject, results),
            as_report(subject, results, self.words, fail_on),
            lambda path: write_html(subject, results, self.words, path, fail_on),
            self.choice,
        )
        return INTERRUPTED if self.interrupted else code

    def play(self, most: int, check: Callable[..., Any]) -> Checked:
        """Run ``check(taps, go_on, print_line, on_result)`` with a progress bar, and with a log if requested.

        The first Ctrl-C ends the check after the present test case, the second one at once; changed values are restored in
        both cases.
        """
        from fieldtwin.cli.test.check_view import CheckProgress
        from fieldtwin.commissioning.access.frame_log import FrameLog
        from fieldtwin.console import stderr
        from fieldtwin.gateway.wallclock import run

        with ExitStack() as stack:
            path = self.files.log_path
            log = stack.enter_context(FrameLog(path, self.words)) if path is not None else None
            progress = stack.enter_context(CheckProgress(most, "examining its answers"))

            def go_on() -> str:
                if self.interrupted:
                    return "interrupted"
                return "the log of sent frames is full" if log is not None and log.full else ""

            async def main() -> Checked:
                taps = (log,) if log is not None else ()
                task = asyncio.ensure_future(check(taps, go_on, progress.print_line, progress.add_result))

                def stop() -> None:
                    if self.interrupted:
                        task.cancel()
                    self.interrupted = True
                    stderr.print("ends after this test case; press Ctrl-C again to end at once", markup=False)

                with suppress(NotImplementedError):  # this platform is not Unix
                    asyncio.get_running_loop().add_signal_handler(signal.SIGINT, stop)
                checked: Checked = await task
                return checked

            try:
                return run(main())
            except asyncio.CancelledError:
                raise KeyboardInterrupt from None

    def subject(
        self, checked: Checked, plan: CasePlan, began: datetime, wrote: tuple[str, ...], timeout_s: float
    ) -> Subject:
        from fieldtwin.results.subject import Subject, who

        return Subject(
            self.protocol, self.endpoint, self.address, checked.identity, began.isoformat(timespec="seconds"),
            round((datetime.now(UTC) - began).total_seconds(), 1), self.care.by or who(), self.words,
            plan.at_most.value, wrote, timeout_s,
        )  # fmt: skip

    def estimate(self, dry_run_result: Checked) -> None:
        """Print the number of cases, and how long they take if the device answers at once, both known from a dry run."""
        from fieldtwin.console import stderr

        played = sum(bool(result.spoken) for result in dry_run_result.results)
        stderr.print(
            f"{played} cases, about {max(1, round(dry_run_result.took_s))} s if the device answers at once; Ctrl-C stops",
            markup=False,
        )

    def print_dry_run(self, checked: Checked) -> int:
        """Print the frames that a dry run would have sent, and return the exit code."""
        from fieldtwin.cli.test.check_view import print_dry_run

        print_dry_run(checked, as_json=self.files.as_json)
        return 0
