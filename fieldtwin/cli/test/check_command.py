"""`fieldtwin check`: run conformance tests against third-party clients, masters and devices."""

from __future__ import annotations

import json
import platform
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fieldtwin.__about__ import __version__
from fieldtwin.cli.options import Duration, json_option, junit_flavour_option
from fieldtwin.cli.test.check_cases import only_of
from fieldtwin.cli.test.check_device_command import canopen, modbus
from fieldtwin.cli.test.fail_on import bases_of, fail_on_option, print_not_counted
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.results.subject import who

if TYPE_CHECKING:
    from fieldtwin.conformance.clients.run import ClientTestOptions
    from fieldtwin.conformance.core.case import Basis, Case
    from fieldtwin.conformance.core.results import CaseResult
    from fieldtwin.emulators.modbus.bank import Table

FILE = click.Path(dir_okay=False, path_type=Path)
DANGERS = ("observe", "read", "write", "disrupt")
_HELD = re.compile(r"^(holding|input|coil|discrete):(\d{1,5})$")
_OBJECT = re.compile(r"^([0-9A-Fa-f]{4}):([0-9A-Fa-f]{2})=((?:[0-9A-Fa-f]{2})+)$")


@click.group("check")
def command() -> None:
    """Run conformance tests on a device, or on a client or master with devices that misbehave.

    Exit code 0 if test cases passed and none that --fail-on counts has failed, else 1. SKIPPED and INCONCLUSIVE neither pass
    nor fail.
    """


def _shared(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of every conformance test."""
    options = [
        click.option("--only", metavar="IDS", help="Run only these test cases or rows, separated by commas: MB-013,MB-015a."),
        click.option(
            "--at-most",
            type=click.Choice(DANGERS),
            default="disrupt",
            show_default=True,
            help="Skip test cases with a higher impact level.",
        ),
        click.option("--for", "for_s", type=Duration(), default="0", help="Begin no case after this time.  [default: no limit]"),
        click.option("--wait", "wait_s", type=Duration(), default="30s", show_default=True,
                     help="Time to wait for the first request."),
        click.option(
            "--patience", "patience_s", type=Duration(), default="10s", show_default=True,
            help="Time for the client or master to recover; longer than its longest pause.",
        ),
        click.option("--waivers", "waivers_path", type=click.Path(path_type=Path),
                     help="YAML file of accepted failures: id, reason, expires."),
        fail_on_option,
        click.option("--junit", type=click.Path(dir_okay=False, path_type=Path), help="Write the verdicts as JUnit XML."),
        junit_flavour_option,
        click.option("--html", type=FILE, help="Write a report with every frame."),
        click.option("-o", "--out", type=FILE, help="Write the JSON to a file."),
        click.option("--log", "log_path", type=FILE, help="Append all sent and received frames, as JSON lines."),
        click.option("--list", "list_only", is_flag=True, help="List the test cases with their basis, and exit."),
        json_option,
    ]  # fmt: skip
    return _with(options, function)


def _seen(what: str, timeout: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add the options for the client's readings and outputs: `what` it reads, and the name of its `timeout`."""
    options = [
        click.option(
            "--probe", default="", metavar="WHERE",
            help="Where the client or master publishes the value: tcp://HOST:PORT/holding:100[+COUNT][@UNIT], output (numbers "
            "that the program prints), or output:TEXT (what it prints after TEXT).",
        ),
        click.option(
            "--timeout", "timeout_s", type=Duration(), default="0", help=f"The master's {timeout}, if you know it."
        ),
        click.option(
            "--values", default="1111,2222,3333", show_default=True, metavar="A,B,BAD",
            help=f"Values of {what}: two valid ones, and one that must never be published.",
        ),
        click.option("--none", "none", multiple=True, metavar="VALUE",
                     help="The probe's text or number for a missing value; repeatable."),
    ]  # fmt: skip
    return lambda function: _with(options, function)


def _with(options: Sequence[Callable[..., Any]], function: Callable[..., Any]) -> Callable[..., Any]:
    """Add all options to `function`, shown in this order."""
    for option in reversed(options):
        function = option(function)
    return function


@command.command("modbus-master")
@click.option(
    "--listen",
    metavar="ENDPOINT",
    help="tcp://HOST:PORT, rtu+tcp://HOST:PORT, pty:PATH, rtu:PORT or ascii:PORT; port 0 selects a free port.",
)
@_seen("registers", "response timeout")
@click.option(
    "--hold",
    multiple=True,
    metavar="TABLE:ADDRESS=VALUE",
    help="A register or bit with a constant value; repeatable.",
)
@click.option("--echo", is_flag=True, help="The client is set up for a line that echoes its requests.")
@click.option("--ascii", "in_ascii", is_flag=True, help="On pty:PATH: the client uses Modbus ASCII.")
@_shared
@click.argument("argv", nargs=-1, type=click.UNPROCESSED, metavar="[-- PROGRAM [ARG]...]")
def modbus_master(
    listen: str | None,
    probe: str,
    timeout_s: float,
    values: str,
    none: tuple[str, ...],
    hold: tuple[str, ...],
    echo: bool,
    in_ascii: bool,
    only: str | None,
    at_most: str,
    for_s: float,
    wait_s: float,
    patience_s: float,
    waivers_path: Path | None,
    fail_on: str,
    junit: Path | None,
    junit_flavour: str,
    html: Path | None,
    out: Path | None,
    log_path: Path | None,
    list_only: bool,
    as_json: bool,
    argv: tuple[str, ...],
) -> int:
    """Test a Modbus client (master) with a server that misbehaves, one test case after another.

    \b
    fieldtwin check modbus-master --listen tcp://127.0.0.1:5020 \\
        --probe tcp://plc:502/holding:100
    fieldtwin check modbus-master --listen pty:/tmp/line --timeout 1s \\
        --probe output -- python my_client.py

    The client keeps its normal polling. A program after -- finds the endpoint in FIELDTWIN_ENDPOINT, FIELDTWIN_HOST and
    FIELDTWIN_PORT, or FIELDTWIN_TTY.

    Exit code 0 if test cases passed and none that --fail-on counts has failed, else 1.
    """
    from fieldtwin.conformance.clients.modbus.cases import CASES
    from fieldtwin.conformance.clients.run import ClientTestOptions
    from fieldtwin.conformance.clients.session import Listener, Options, judge_modbus_master
    from fieldtwin.conformance.core.case import Impact

    cases = [case.about for case in CASES]
    if list_only:
        return _list(cases, as_json)
    if not listen:
        raise UsageError("no endpoint to listen on", expected="--listen ENDPOINT")
    plan = ClientTestOptions(
        only_of(only, cases), timeout_s, patience_s, wait_s, for_s, frozenset({"echo"} if echo else ()), Impact(at_most)
    )
    options = Options(
        Endpoint.parse(listen), plan, _words(values), probe, frozenset(none), _held(hold), in_ascii, command=argv
    )
    return _judged(
        lambda listener: judge_modbus_master(options, listener),
        Listener,
        cases,
        waivers_path,
        Files(junit, junit_flavour, html, out, log_path),
        as_json,
        listen,
        plan,
        bases_of(fail_on),
        "modbus",
    )


@command.command("canopen-master")
@click.option("--listen", metavar="ENDPOINT", help="can:fieldtwin/HOST:PORT (created), or can:socketcan/INTERFACE.")
@click.option("--bitrate", type=click.IntRange(10_000, 1_000_000), default=125_000, show_default=True, help="bit/s")
@click.option(
    "--node",
    "nodes",
    multiple=True,
    type=click.IntRange(1, 127),
    help="A node that boots without a command; repeatable.",
)
@click.option("--heartbeat", "heartbeat_s", type=Duration(), default="1s", show_default=True, help="0: none.")
@click.option("--size", type=click.Choice(["2", "4"]), default="4", show_default=True, help="Bytes of an object.")
@click.option(
    "--hold",
    multiple=True,
    metavar="INDEX:SUB=HEX",
    help="An object's bytes as sent, such as 6041:00=3702; repeatable.",
)
@_seen("objects", "SDO timeout")
@_shared
@click.argument("argv", nargs=-1, type=click.UNPROCESSED, metavar="[-- PROGRAM [ARG]...]")
def canopen_master(
    listen: str | None,
    bitrate: int,
    nodes: tuple[int, ...],
    heartbeat_s: float,
    size: str,
    hold: tuple[str, ...],
    probe: str,
    timeout_s: float,
    values: str,
    none: tuple[str, ...],
    only: str | None,
    at_most: str,
    for_s: float,
    wait_s: float,
    patience_s: float,
    waivers_path: Path | None,
    fail_on: str,
    junit: Path | None,
    junit_flavour: str,
    html: Path | None,
    out: Path | None,
    log_path: Path | None,
    list_only: bool,
    as_json: bool,
    argv: tuple[str, ...],
) -> int:
    """Test a CANopen master with nodes that misbehave, one test case after another.

    \b
    fieldtwin check canopen-master --listen can:fieldtwin/127.0.0.1:29536 \\
        --probe output -- python my_master.py
    fieldtwin check canopen-master --listen can:socketcan/vcan0 --node 5 \\
        --probe tcp://plc:502/holding:100

    Every node ID answers SDO requests. A program after -- finds the bus in FIELDTWIN_ENDPOINT, FIELDTWIN_INTERFACE and
    FIELDTWIN_CHANNEL, which are python-can's names.

    Exit code 0 if test cases passed and none that --fail-on counts has failed, else 1.
    """
    from fieldtwin.conformance.clients.canopen.cases import CASES
    from fieldtwin.conformance.clients.run import ClientTestOptions
    from fieldtwin.conformance.clients.session import Listener, Options, judge_canopen_master
    from fieldtwin.conformance.core.case import Impact

    cases = [case.about for case in CASES]
    if list_only:
        return _list(cases, as_json)
    if not listen:
        raise UsageError("no endpoint to listen on", expected="--listen ENDPOINT")
    plan = ClientTestOptions(only_of(only, cases), timeout_s, patience_s, wait_s, for_s, frozenset(), Impact(at_most))
    options = Options(
        Endpoint.parse(listen), plan, _words(values), probe, frozenset(none), command=argv, objects=_objects(hold),
        size=int(size), nodes=frozenset(nodes), heartbeat_s=heartbeat_s, bitrate=bitrate,
    )  # fmt: skip
    return _judged(
        lambda listener: judge_canopen_master(options, listener),
        Listener,
        cases,
        waivers_path,
        Files(junit, junit_flavour, html, out, log_path),
        as_json,
        listen,
        plan,
        bases_of(fail_on),
        "canopen",
    )


def _objects(texts: tuple[str, ...]) -> dict[tuple[int, int], bytes]:
    held = {}
    for text in texts:
        match = _OBJECT.match(text)
        if not match:
            raise UsageError("--hold", expected="such as 6041:00=3702", got=repr(text))
        held[int(match[1], 16), int(match[2], 16)] = bytes.fromhex(match[3])
    return held


@dataclass(frozen=True)
class Files:
    """The files written in addition to the table."""

    junit: Path | None
    junit_flavour: str
    html: Path | None
    out: Path | None
    log: Path | None


def _judged(
    judge: Callable[..., Any],
    listener_type: Callable[..., Any],
    cases: list[Case],
    waivers_path: Path | None,
    files: Files,
    as_json: bool,
    title: str,
    plan: ClientTestOptions,
    fail_on: frozenset[Basis],
    protocol: str,
) -> int:
    """Run the test, show the results, write the files, and return the exit code."""
    from fieldtwin.cli.test.check_view import Progress, print_results
    from fieldtwin.conformance.clients.frame_log import MasterLog
    from fieldtwin.conformance.core.results import as_json as data_of
    from fieldtwin.conformance.core.results import exit_code, waive
    from fieldtwin.conformance.core.waivers import Waivers, load_waivers
    from fieldtwin.gateway.wallclock import run

    argv = sys.argv[1:]
    known = {case.id for case in cases} | {case.row for case in cases}
    waivers = load_waivers(waivers_path, known) if waivers_path else Waivers()
    started = datetime.now(UTC)
    with ExitStack() as stack:
        log = stack.enter_context(MasterLog(files.log, title, shlex.join(["fieldtwin", *argv]))) if files.log else None
        progress = stack.enter_context(Progress(sum(case.chosen(plan.only) for case in cases)))
        listener = listener_type(progress.say, progress.tell, *([log.on_event] if log is not None else []))
        found: list[CaseResult] = run(judge(listener))
    results = [waive(result, waivers, started.date()) for result in found]
    about = {
        "protocol": protocol,
        "endpoint": title,
        "started": started.isoformat(timespec="seconds"),
        "took_s": round((datetime.now(UTC) - started).total_seconds(), 3),
        "by": who(),
        "host": platform.node(),
        "command": shlex.join(["fieldtwin", *argv]),
        "at_most": plan.at_most.value,
        "fieldtwin": __version__,
    }
    document = json.dumps(data_of(about, results, argv), indent=2) + "\n"
    _write(files, results, document, f"master on {title}", started, fail_on)
    if as_json:
        sys.stdout.write(document)
    else:
        print_results(results, all_wires=bool(plan.only))
        print_not_counted(results, fail_on)
    return exit_code(results, fail_on)


def _write(
    files: Files, results: list[CaseResult], document: str, title: str, started: datetime, fail_on: frozenset[Basis]
) -> None:
    from fieldtwin.conformance.core.results import as_report
    from fieldtwin.reports.conformance.client import write_master_html
    from fieldtwin.reports.file import put
    from fieldtwin.reports.junit import Flavour, write_junit

    argv, began = sys.argv[1:], started.isoformat(timespec="seconds")
    if files.junit is not None:
        write_junit(as_report(results, title, argv, began, fail_on), files.junit, Flavour(files.junit_flavour))
    if files.html is not None:
        write_master_html(results, title, argv, began, files.html, fail_on)
    if files.out is not None:
        put(files.out, document)


def _list(cases: list[Case], as_json: bool) -> int:
    from fieldtwin.cli.test.check_view import listed, print_cases

    if as_json:
        json.dump([listed(case) for case in cases], sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        print_cases(cases)
    return 0


def _words(text: str) -> tuple[int, int, int]:
    parts = text.split(",")
    if len(parts) != 3 or not all(p.strip().isdigit() and 0 < int(p) < 65536 for p in parts) or len(set(parts)) != 3:
        raise UsageError(
            "--values", expected="three different numbers from 1 to 65535 such as 1111,2222,3333", got=text
        )
    a, b, bad = (int(p) for p in parts)
    return a, b, bad


def _held(texts: tuple[str, ...]) -> dict[tuple[Table, int], int]:
    held: dict[tuple[Table, int], int] = {}
    for text in texts:
        where, _, value = text.partition("=")
        match = _HELD.match(where)
        if not match or not value.isdigit() or int(value) > 65535 or int(match[2]) > 65535:
            raise UsageError("--hold", expected="such as holding:10=5", got=repr(text))
        held[match[1], int(match[2])] = int(value)  # type: ignore[index]
    return held


command.add_command(modbus)
command.add_command(canopen)
