"""`fieldtwin check modbus` and `fieldtwin check canopen`: devices that we did not write are judged from outside."""

from __future__ import annotations

import json
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from fieldtwin.cli.options import Duration, json_option
from gateway.core.endpoint import Endpoint
from gateway.core.errors import NotAllowed, UsageError

if TYPE_CHECKING:
    from fieldtwin.checking.checked import Checked
    from fieldtwin.checking.device_case import DeviceCase, DeviceResult
    from fieldtwin.checking.run import Plan
    from fieldtwin.checking.subject import Subject

DANGERS = ("observe", "read", "write", "disrupt")
_WRITES = "writes, wrong ones too; what is given by --write gets back what was there"
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
_CELL = re.compile(r"^(holding|coil|input|discrete):(\d{1,5})(?:\+(\d{1,3}))?$")
_OBJECT = re.compile(r"^([0-9A-Fa-f]{4})h?(?::([0-9A-Fa-f]{1,2}))?$")
F = TypeVar("F", bound=Callable[..., Any])


def shared(function: F) -> F:
    """Options of every check of a device."""
    options = [
        click.option(
            "--allow", type=click.Choice(DANGERS), help="The most dangerous cases to play.  [default: read; write with --write]"
        ),
        click.option("--yes", is_flag=True, help="Do not ask before cases that write or disrupt."),
        click.option("--i-know", is_flag=True, help="Also what reaches every device on the line, or restarts this one."),
        click.option("--dry-run", is_flag=True, help="Show what would be sent, and send nothing."),
        click.option("--only", metavar="IDS", help="These cases or rows only, with commas: MB-036,MB-045a."),
        click.option("--rate", type=click.FloatRange(0.1, 10_000), default=20.0, show_default=True,
                     help="Requests a second, at most."),
        click.option("--for", "for_s", type=Duration(), default="0", help="Begin no case after this time."),
        click.option("--waivers", "waivers_path", type=click.Path(path_type=Path), help="YAML: id, reason, expires."),
        click.option("--by", help="Who checks; stands in the reports.  [default: the name you are logged in by]"),
        click.option("--html", type=FILE, help="Write a report with every byte."),
        click.option("--junit", type=FILE, help="Write the verdicts as JUnit XML."),
        click.option("-o", "--out", type=FILE, help="Write the JSON to a file, for `fieldtwin report`."),
        click.option("--log", "log_path", type=FILE, help="Append all that is sent and heard, as JSON lines."),
        click.option("--list", "list_only", is_flag=True, help="Show the cases and end."),
        json_option,
    ]  # fmt: skip
    for option in reversed(options):
        function = option(function)
    return function


class Check:
    """What the two commands have in common: the plan, the question, the files."""

    def __init__(self, protocol: str, endpoint: str, address: int, options: dict[str, Any]) -> None:
        self.protocol, self.endpoint, self.address, self.options = protocol, endpoint, address, options
        self.words = "fieldtwin " + shlex.join(sys.argv[1:])

    def plan(self, cases: Sequence[DeviceCase[Any]], has: set[str], writes: bool) -> Plan:
        """What may be played. Reads the waivers too: a wrong file is said before anything is sent."""
        from fieldtwin.checking.run import Plan
        from fieldtwin.cli.check_command import only_of
        from fieldtwin.conformance.case import Danger
        from fieldtwin.conformance.waivers import Waivers, load_waivers

        path = self.options["waivers_path"]
        known = {case.id for case in cases} | {case.row for case in cases}
        self.waivers = load_waivers(path, known) if path else Waivers()
        allow = self.options["allow"] or ("write" if writes else "read")
        if writes and Danger(allow).rank < Danger.WRITE.rank:
            raise UsageError("--write with cases that only read", expected="--allow write or disrupt", got=allow)
        if self.options["i_know"]:
            has = has | {"i-know"}
        return Plan(only_of(self.options["only"], cases), Danger(allow), frozenset(has), self.options["for_s"])

    def ask(self, cases: Sequence[DeviceCase[Any]], plan: Plan, traits: frozenset[str]) -> None:
        """Ask about what is more than reading. Raises `NotAllowed` where nobody can answer, `Abort` on a no."""
        from fieldtwin.checking.run import why_not
        from fieldtwin.cli.talk import talk
        from fieldtwin.conformance.case import Danger

        played = [c for c in cases if c.chosen(plan.only) and not why_not(c, plan, traits)]
        risky = [c for c in played if c.danger.rank > Danger.READ.rank]
        if not risky or self.options["yes"]:
            return
        for danger, means in MEANS[self.protocol].items():
            ids = [c.id for c in risky if c.danger.value == danger]
            if ids:
                talk.print(f"{len(ids)} cases of danger {danger}: {means}.\n  {', '.join(ids)}", markup=False)
        if not sys.stdin.isatty():
            raise NotAllowed("cases that do more than reading are confirmed", expected="--yes, or a terminal to ask on")
        click.confirm("Play them?", abort=True, err=True)

    def done(self, subject: Subject, checked: Checked) -> int:
        """Waive, write the files, show the table. The exit code."""
        from fieldtwin.checking.results import as_json, as_report
        from fieldtwin.checking.run import OTHER_WIRE
        from fieldtwin.cli.check_view import print_results
        from fieldtwin.cli.talk import talk
        from fieldtwin.conformance.results import exit_code, waive

        today = datetime.fromisoformat(subject.started).date()
        results: list[DeviceResult] = [waive(result, self.waivers, today) for result in checked.results]  # type: ignore[misc]
        document = as_json(subject, results)
        if self.options["out"] is not None:
            _write(self.options["out"], json.dumps(document, indent=2) + "\n")
        if self.options["junit"] is not None:
            from fieldtwin.report.junit import write_junit

            write_junit(as_report(subject, results, self.words), self.options["junit"])
        if self.options["html"] is not None:
            from fieldtwin.checking.html import write_html

            write_html(subject, results, self.words, self.options["html"])
        if self.options["as_json"]:
            json.dump(document, sys.stdout, indent=2)
            sys.stdout.write("\n")
        else:
            elsewhere = [] if self.options["only"] else [r for r in results if r.reason == OTHER_WIRE]
            print_results([r for r in results if r not in elsewhere], "what is asked")
            if elsewhere:
                talk.print(f"{len(elsewhere)} more cases are for other wires", markup=False)
        return exit_code(results)

    def subject(
        self, checked: Checked, plan: Plan, began: datetime, wrote: tuple[str, ...], timeout_s: float
    ) -> Subject:
        from fieldtwin.checking.subject import Subject, who

        return Subject(
            self.protocol, self.endpoint, self.address, checked.identity, began.isoformat(timespec="seconds"),
            round((datetime.now(UTC) - began).total_seconds(), 1), self.options["by"] or who(), self.words,
            plan.at_most.value, wrote, timeout_s,
        )  # fmt: skip

    def estimate(self, on_paper: Checked) -> None:
        """Say how many cases there are and how long they take with a device that answers at once."""
        from fieldtwin.cli.talk import talk

        played = sum(bool(result.spoken) for result in on_paper.results)
        talk.print(
            f"{played} cases, about {max(1, round(on_paper.took_s))} s where it answers at once; Ctrl-C stops",
            markup=False,
        )

    def on_paper(self, checked: Checked) -> int:
        """What would be sent."""
        from fieldtwin.cli.check_view import print_paper

        print_paper(checked, as_json=self.options["as_json"])
        return 0


@click.command("modbus")
@click.argument("endpoint", required=False)
@click.option("--unit", type=click.IntRange(0, 255), default=1, show_default=True, help="The unit id.")
@click.option(
    "--read", "reads", multiple=True, metavar="TABLE:ADDRESS",
    help="A cell that can be read, such as holding:100, where none is near 0, 1, 100, 1000 or 40000; repeatable.",
)  # fmt: skip
@click.option(
    "--write", "writes", multiple=True, metavar="TABLE:ADDRESS[+COUNT]",
    help="A cell that may be written, holding or coil; what was there is put back. Repeatable.",
)  # fmt: skip
@click.option("--timeout", "timeout_s", type=Duration(), default="1s", show_default=True, help="For each reply.")
@click.option("--echo", is_flag=True, help="The adapter hears what it sends.")
@shared
def modbus(
    endpoint: str | None,
    unit: int,
    reads: tuple[str, ...],
    writes: tuple[str, ...],
    timeout_s: float,
    echo: bool,
    **options: Any,
) -> int:
    """Judge a Modbus device from outside: the rows of the catalogue that a master can ask for.

    \b
    fieldtwin check modbus tcp://192.0.2.7:502 --unit 1 --html unit1.html
    fieldtwin check modbus 'rtu:/dev/ttyUSB0?baudrate=9600&frame=8N1' --unit 17
    fieldtwin check modbus tcp://192.0.2.7:502 --write holding:100 --dry-run

    Reads only, unless told otherwise. Exit code 0 when cases passed and none failed.
    """
    from fieldtwin.checking.modbus_cases import CASES
    from fieldtwin.checking.modbus_session import ModbusOptions, check_modbus, traits_of
    from fieldtwin.checking.paper import modbus_on_paper

    if options["list_only"]:
        return _list(CASES, options["as_json"])
    if not endpoint:
        raise UsageError("no device to check", expected="an endpoint such as tcp://192.0.2.7:502")
    traits = traits_of(Endpoint.parse(endpoint))
    may_write = {table: (at, count) for table, at, count in map(_cell, writes)}
    if set(may_write) - {"holding", "coil"}:
        raise UsageError("--write", expected="holding:ADDRESS or coil:ADDRESS", got=", ".join(writes))
    check = Check("modbus", endpoint, unit, options)
    plan = check.plan(CASES, set(may_write), bool(writes))
    to_do = ModbusOptions(
        endpoint, unit, plan, timeout_s, 1 / options["rate"], echo,
        {table: at for table, at, _ in map(_cell, reads)}, may_write,
    )  # fmt: skip
    on_paper = modbus_on_paper(to_do)
    if options["dry_run"]:
        return check.on_paper(on_paper)
    check.ask(CASES, plan, traits)
    check.estimate(on_paper)
    began = datetime.now(UTC)
    checked = played(
        len([c for c in CASES if c.chosen(plan.only)]), options["log_path"], check.words,
        lambda taps, go_on, say, tell: check_modbus(replace(to_do, taps=taps, go_on=go_on), say, tell),
    )  # fmt: skip
    return check.done(check.subject(checked, plan, began, writes, timeout_s), checked)


@click.command("canopen")
@click.argument("endpoint", required=False)
@click.option("--node", type=click.IntRange(1, 127), help="The node id.")
@click.option(
    "--eds",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Its data sheet, EDS or DCF: for limits and access.",
)
@click.option("--bitrate", type=click.IntRange(10_000, 1_000_000), help="bit/s, where the bus does not know it.")
@click.option(
    "--write", "writes", multiple=True, metavar="INDEX:SUB",
    help="An object that may be written, such as 2000:00 or 1017:00; what was there is put back. Repeatable.",
)  # fmt: skip
@click.option("--timeout", "timeout_s", type=Duration(), default="500ms", show_default=True, help="For each SDO reply.")
@click.option(
    "--boot", "boot_s", type=Duration(), default="10s", show_default=True, help="For a boot-up after a reset."
)
@shared
def canopen(
    endpoint: str | None,
    node: int | None,
    eds: Path | None,
    bitrate: int | None,
    writes: tuple[str, ...],
    timeout_s: float,
    boot_s: float,
    **options: Any,
) -> int:
    """Judge a CANopen node from outside: the rows of the catalogue that a master can ask for.

    \b
    fieldtwin check canopen can:socketcan/can0 --node 5 --eds inclinometer.eds
    fieldtwin check canopen can:fieldtwin/127.0.0.1:29536 --node 5 --write 1017:00

    Uploads only, unless told otherwise. Exit code 0 when cases passed and none failed.
    """
    from fieldtwin.checking.canopen_cases import CASES
    from fieldtwin.checking.canopen_session import CanopenOptions, check_canopen
    from fieldtwin.checking.paper import canopen_on_paper

    if options["list_only"]:
        return _list(CASES, options["as_json"])
    if not endpoint or node is None:
        raise UsageError("no node to check", expected="an endpoint such as can:socketcan/can0, and --node")
    if not Endpoint.parse(endpoint).is_can:
        raise UsageError("CANopen is spoken on a CAN bus", expected="such as can:socketcan/can0", got=endpoint)
    may_write = tuple(_object(text) for text in writes)
    check = Check("canopen", endpoint, node, options)
    has = ({"object"} if may_write else set()) | ({"eds"} if eds is not None else set())
    plan = check.plan(CASES, has, bool(writes))
    to_do = CanopenOptions(endpoint, node, plan, bitrate or 0, timeout_s, 1 / options["rate"], boot_s, eds, may_write)
    on_paper = canopen_on_paper(to_do)
    if options["dry_run"]:
        return check.on_paper(on_paper)
    check.ask(CASES, plan, frozenset({"can"}))
    check.estimate(on_paper)
    began = datetime.now(UTC)
    checked = played(
        len([c for c in CASES if c.chosen(plan.only)]), options["log_path"], check.words,
        lambda taps, go_on, say, tell: check_canopen(replace(to_do, taps=taps, go_on=go_on), say, tell),
    )  # fmt: skip
    return check.done(check.subject(checked, plan, began, writes, timeout_s), checked)


def _object(text: str) -> tuple[int, int]:
    match = _OBJECT.match(text)
    if not match:
        raise UsageError("an object", expected="index and subindex in hex, such as 2000:00", got=repr(text))
    return int(match[1], 16), int(match[2] or "0", 16)


def played(
    most: int, log_path: Path | None, words: str, check: Callable[..., Any]
) -> Checked:  # ``check(taps, go_on, say, tell)`` -> a coroutine
    """Run it with a bar, and with a log where one is wanted."""
    from contextlib import ExitStack

    from fieldtwin.cli.check_view import Progress
    from fieldtwin.commissioning.wire_log import WireLog
    from gateway.wallclock import run

    with ExitStack() as stack:
        log = stack.enter_context(WireLog(log_path, words)) if log_path is not None else None
        progress = stack.enter_context(Progress(most, "looking how it answers"))
        taps = (log,) if log is not None else ()

        def go_on() -> str:
            return "the log of what is sent is full" if log is not None and log.full else ""

        result: Checked = run(check(taps, go_on, progress.say, progress.tell))
        return result


def _cell(text: str) -> tuple[str, int, int]:
    match = _CELL.match(text)
    if not match or int(match[2]) > 0xFFFF or int(match[2]) + int(match[3] or 1) > 0x10000 or match[3] == "0":
        raise UsageError(
            "a cell", expected="such as holding:100 or coil:5, with +COUNT behind it if need be", got=repr(text)
        )
    return match[1], int(match[2]), int(match[3] or 1)


def _list(cases: Sequence[DeviceCase[Any]], as_json: bool) -> int:
    from fieldtwin.cli.check_view import print_cases

    if as_json:
        keys = ("id", "title", "clause", "does", "must")
        listed = [
            {k: getattr(c, k) for k in keys} | {"danger": c.danger.value, "wires": c.wires, "needs": c.needs}
            for c in cases
        ]
        json.dump(listed, sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        print_cases(cases, "what is sent", "what the device must do")
    return 0


def _write(path: Path, text: str) -> None:
    from gateway.core.errors import FileInvalid

    try:
        path.write_text(text, encoding="utf-8")
    except OSError as e:
        raise FileInvalid(f"cannot write the file: {e.strerror or e}", path=str(path)) from e
