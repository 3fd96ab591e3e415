"""Shared parts of `fieldtwin check modbus` and `check canopen`: options, confirmation, progress bar, output files."""

from __future__ import annotations

import asyncio
import json
import shlex
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from fieldtwin.cli.options import Duration, json_option, junit_flavour_option
from fieldtwin.cli.test.fail_on import bases_of, fail_on_option, print_not_counted
from fieldtwin.gateway.core.errors import NotAllowed, UsageError

if TYPE_CHECKING:
    from fieldtwin.conformance.devices.checked import Checked
    from fieldtwin.conformance.devices.device_case import DeviceCase, DeviceResult
    from fieldtwin.conformance.devices.run import DeviceTestOptions
    from fieldtwin.results.subject import Subject

DANGERS = ("observe", "read", "write", "disrupt")
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
FILE = click.Path(dir_okay=False, path_type=Path)
INTERRUPTED = 130
F = TypeVar("F", bound=Callable[..., Any])


def shared(function: F) -> F:
    """Add the options of every device check."""
    options = [
        click.option(
            "--allow", type=click.Choice(DANGERS), help="Highest impact level to run.  [default: read; write with --write]"
        ),
        click.option("--yes", is_flag=True, help="Do not ask before cases that write or disrupt."),
        click.option("--i-know", is_flag=True, help="Also run cases that reach every device on the line, or restart this one."),
        click.option("--dry-run", is_flag=True, help="Show the frames that would be sent; send nothing."),
        click.option("--only", metavar="IDS", help="Run only these test cases or rows, separated by commas: MB-036,MB-045a."),
        click.option("--rate", type=click.FloatRange(0.1, 10_000), default=20.0, show_default=True,
                     help="Maximum requests per second."),
        click.option("--for", "for_s", type=Duration(), default="0", help="Begin no test case after this time."),
        click.option("--waivers", "waivers_path", type=click.Path(path_type=Path), help="YAML: accepted failures."),
        fail_on_option,
        click.option("--by", help="Name of the tester, for the reports.  [default: your login name]"),
        click.option("--html", type=FILE, help="Write a report with every byte."),
        click.option("--junit", type=FILE, help="Write the verdicts as JUnit XML."),
        junit_flavour_option,
        click.option("-o", "--out", type=FILE, help="Write the JSON to a file, for `fieldtwin report`."),
        click.option("--log", "log_path", type=FILE, help="Append all sent and received frames, as JSON lines."),
        click.option("--list", "list_only", is_flag=True, help="List the test cases and exit."),
        json_option,
    ]  # fmt: skip
    for option in reversed(options):
        function = option(function)
    return function


class Check:
    """The common parts of the two commands: the plan, the confirmation, the files."""

    def __init__(self, protocol: str, endpoint: str, address: int, options: dict[str, Any]) -> None:
        self.protocol, self.endpoint, self.address, self.options = protocol, endpoint, address, options
        self.words = "fieldtwin " + shlex.join(sys.argv[1:])
        self.interrupted = False

    def plan(self, cases: Sequence[DeviceCase[Any]], has: set[str], writes: bool) -> DeviceTestOptions:
        """Return the plan. Also read the waivers, so that an invalid file is reported before anything is sent."""
        from fieldtwin.cli.test.check_cases import only_of
        from fieldtwin.conformance.core.case import Impact
        from fieldtwin.conformance.core.waivers import Waivers, load_waivers
        from fieldtwin.conformance.devices.run import DeviceTestOptions

        path = self.options["waivers_path"]
        known = {case.id for case in cases} | {case.row for case in cases}
        self.waivers = load_waivers(path, known) if path else Waivers()
        allow = self.options["allow"] or ("write" if writes else "read")
        if writes and Impact(allow).rank < Impact.WRITE.rank:
            raise UsageError("--write needs test cases that write", expected="--allow write or disrupt", got=allow)
        if self.options["i_know"]:
            has = has | {"i-know"}
        return DeviceTestOptions(
            only_of(self.options["only"], cases), Impact(allow), frozenset(has), self.options["for_s"]
        )

    def ask(self, cases: Sequence[DeviceCase[Any]], plan: DeviceTestOptions, traits: frozenset[str]) -> None:
        """Ask before anything except reading is sent. Raises `NotAllowed` without a terminal, `Abort` if the answer is no."""
        from fieldtwin.conformance.core.case import Impact
        from fieldtwin.conformance.devices.run import why_not
        from fieldtwin.console import stderr

        played = [c for c in cases if c.chosen(plan.only) and not why_not(c, plan, traits)]
        risky = [c for c in played if c.danger.rank > Impact.READ.rank]
        if not risky or self.options["yes"]:
            return
        for danger, means in MEANS[self.protocol].items():
            ids = [c.id for c in risky if c.danger.value == danger]
            if ids:
                stderr.print(
                    f"{len(ids)} test cases with impact level {danger}: {means}.\n  {', '.join(ids)}", markup=False
                )
        if not sys.stdin.isatty():
            raise NotAllowed(
                "test cases that do more than read need a confirmation", expected="--yes, or a terminal to ask on"
            )
        click.confirm("Play them?", abort=True, err=True)

    def done(self, subject: Subject, checked: Checked) -> int:
        """Apply the waivers, write the files, show the table, and return the exit code."""
        from fieldtwin.cli.test.check_view import print_results
        from fieldtwin.conformance.core.results import exit_code, waive
        from fieldtwin.conformance.devices.results import as_json, as_report

        fail_on = bases_of(self.options["fail_on"])
        today = datetime.fromisoformat(subject.started).date()
        results: list[DeviceResult] = [waive(result, self.waivers, today) for result in checked.results]  # type: ignore[misc]
        document = as_json(subject, results)
        if self.options["out"] is not None:
            _write(self.options["out"], json.dumps(document, indent=2) + "\n")
        if self.options["junit"] is not None:
            from fieldtwin.reports.junit import Flavour, write_junit

            flavour = Flavour(self.options["junit_flavour"])
            write_junit(as_report(subject, results, self.words, fail_on), self.options["junit"], flavour)
        if self.options["html"] is not None:
            from fieldtwin.reports.conformance.device import write_html

            write_html(subject, results, self.words, self.options["html"], fail_on)
        if self.options["as_json"]:
            json.dump(document, sys.stdout, indent=2)
            sys.stdout.write("\n")
        else:
            print_results(results, "request", all_wires=bool(self.options["only"]))
            print_not_counted(results, fail_on)
        return INTERRUPTED if self.interrupted else exit_code(results, fail_on)

    def play(self, most: int, check: Callable[..., Any]) -> Checked:
        """Run ``check(taps, go_on, say, tell)`` with a progress bar, and with a log if requested.

        Ctrl-C ends it after the present test case, a second one at once; changed values are restored in any case.
        """
        from fieldtwin.cli.test.check_view import Progress
        from fieldtwin.commissioning.access.frame_log import FrameLog
        from fieldtwin.console import stderr
        from fieldtwin.gateway.wallclock import run

        with ExitStack() as stack:
            path = self.options["log_path"]
            log = stack.enter_context(FrameLog(path, self.words)) if path is not None else None
            progress = stack.enter_context(Progress(most, "examining its answers"))

            def go_on() -> str:
                if self.interrupted:
                    return "interrupted"
                return "the log of sent frames is full" if log is not None and log.full else ""

            async def main() -> Checked:
                taps = (log,) if log is not None else ()
                task = asyncio.ensure_future(check(taps, go_on, progress.say, progress.tell))

                def stop() -> None:
                    if self.interrupted:
                        task.cancel()
                    self.interrupted = True
                    stderr.print("ends after this test case; press Ctrl-C again to end at once", markup=False)

                with suppress(NotImplementedError):  # not on Unix
                    asyncio.get_running_loop().add_signal_handler(signal.SIGINT, stop)
                checked: Checked = await task
                return checked

            try:
                return run(main())
            except asyncio.CancelledError:
                raise KeyboardInterrupt from None

    def subject(
        self, checked: Checked, plan: DeviceTestOptions, began: datetime, wrote: tuple[str, ...], timeout_s: float
    ) -> Subject:
        from fieldtwin.results.subject import Subject, who

        return Subject(
            self.protocol, self.endpoint, self.address, checked.identity, began.isoformat(timespec="seconds"),
            round((datetime.now(UTC) - began).total_seconds(), 1), self.options["by"] or who(), self.words,
            plan.at_most.value, wrote, timeout_s,
        )  # fmt: skip

    def estimate(self, on_paper: Checked) -> None:
        """Return the number of cases and their duration with a device that answers at once."""
        from fieldtwin.console import stderr

        played = sum(bool(result.spoken) for result in on_paper.results)
        stderr.print(
            f"{played} cases, about {max(1, round(on_paper.took_s))} s if the device answers at once; Ctrl-C stops",
            markup=False,
        )

    def on_paper(self, checked: Checked) -> int:
        """Print the frames of a dry run."""
        from fieldtwin.cli.test.check_view import print_dry_run

        print_dry_run(checked, as_json=self.options["as_json"])
        return 0


def list_cases(cases: Sequence[DeviceCase[Any]], as_json: bool) -> int:
    from fieldtwin.cli.test.check_view import listed, print_cases

    if as_json:
        json.dump([listed(c) | {"wires": c.wires, "needs": c.needs} for c in cases], sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        print_cases(cases, "what is sent", "what the device must do")
    return 0


def _write(path: Path, text: str) -> None:
    from fieldtwin.gateway.core.errors import FileInvalid

    try:
        path.write_text(text, encoding="utf-8")
    except OSError as e:
        raise FileInvalid(f"cannot write the file: {e.strerror or e}", path=str(path)) from e
