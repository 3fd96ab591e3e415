"""`fieldtwin check`: run conformance tests against third-party clients, masters and devices."""

from __future__ import annotations

import platform
import re
import shlex
import sys
from collections.abc import Callable, Coroutine, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import click

from fieldtwin.__about__ import __version__
from fieldtwin.cli.option_groups import GroupedCommand, group, option
from fieldtwin.cli.options import Duration
from fieldtwin.cli.test.check_device_command import canopen, modbus
from fieldtwin.cli.test.check_options import IMPACTS, CaseOptions, ResultOptions
from fieldtwin.cli.test.check_site_command import site
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.results.subject import who

if TYPE_CHECKING:
    from fieldtwin.conformance.clients.run import ClientPlan
    from fieldtwin.conformance.clients.session import Listener
    from fieldtwin.conformance.core.case import ClientCase
    from fieldtwin.conformance.core.results import CaseResult
    from fieldtwin.emulators.modbus.bank import Table

RENAMED = {"modbus-master": "modbus-client"}
_HELD = re.compile(r"^(holding|input|coil|discrete):(\d{1,5})$")
_OBJECT = re.compile(r"^([0-9A-Fa-f]{4}):([0-9A-Fa-f]{2})=((?:[0-9A-Fa-f]{2})+)$")


class _CheckGroup(click.Group):
    """The group of checks. An old name of a command raises an error that names the new one."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args[0] in RENAMED:
            raise click.UsageError(f"{args[0]!r} is now called {RENAMED[args[0]]!r}", ctx)
        return super().resolve_command(ctx, args)


@click.group("check", cls=_CheckGroup)
def command() -> None:
    """Run conformance tests on a device, or on a client or master with devices that misbehave; or check a site's files.

    Exit code 0 if test cases passed and none that --fail-on counts has failed, else 1. SKIPPED and INCONCLUSIVE neither pass
    nor fail.
    """


@dataclass(frozen=True)
class ClientOptions:
    """The options for the published values of the client or master under test, and for its timeouts."""

    probe: str = option(
        "--probe",
        default="",
        metavar="WHERE",
        help="Where the client or master publishes the value: tcp://HOST:PORT/holding:100[+COUNT][@UNIT], output (numbers "
        "that the program prints), or output:TEXT (what it prints after TEXT).",
    )
    values: str = option(
        "--values",
        default="1111,2222,3333",
        show_default=True,
        metavar="A,B,BAD",
        help="Values of the registers or objects: two valid ones, and one that must never be published.",
    )
    none: tuple[str, ...] = option(
        "--none", multiple=True, metavar="VALUE", help="The probe's text or number for a missing value; repeatable."
    )
    timeout_s: float = option(
        "--timeout", type=Duration(), default="0", help="The timeout of the client or master, if you know it."
    )
    wait_s: float = option(
        "--wait", type=Duration(), default="30s", show_default=True, help="Time to wait for the first request."
    )
    patience_s: float = option(
        "--patience",
        type=Duration(),
        default="10s",
        show_default=True,
        help="Time for the client or master to recover; longer than its longest pause.",
    )
    at_most: str = option(
        "--at-most",
        type=click.Choice(IMPACTS),
        default="disrupt",
        show_default=True,
        help="Skip test cases with a higher impact level.",
    )

    def plan(self, choice: CaseOptions, cases: Sequence[ClientCase], has: frozenset[str] = frozenset()) -> ClientPlan:
        """Return the plan. `has` are the options that some cases need."""
        from fieldtwin.conformance.clients.run import ClientPlan
        from fieldtwin.conformance.core.case import Impact

        return ClientPlan(
            choice.chosen(cases), Impact(self.at_most), has, choice.for_s, self.timeout_s, self.patience_s, self.wait_s
        )


@command.command("modbus-client", cls=GroupedCommand)
@group(
    "Simulated devices",
    click.option(
        "--listen",
        metavar="ENDPOINT",
        help="tcp://HOST:PORT, rtu+tcp://HOST:PORT, pty:PATH, rtu:PORT or ascii:PORT; port 0 selects a free port.",
    ),
    click.option(
        "--hold",
        multiple=True,
        metavar="TABLE:ADDRESS=VALUE",
        help="A register or bit with a constant value; repeatable.",
    ),
    click.option("--echo", is_flag=True, help="The client is set up for a line that echoes its requests."),
    click.option("--ascii", "in_ascii", is_flag=True, help="On pty:PATH: the client uses Modbus ASCII."),
)
@group("Client or master", client=ClientOptions)
@group("Test cases", choice=CaseOptions)
@group("Results", files=ResultOptions)
@click.argument("argv", nargs=-1, type=click.UNPROCESSED, metavar="[-- PROGRAM [ARG]...]")
def modbus_client(
    listen: str | None,
    hold: tuple[str, ...],
    echo: bool,
    in_ascii: bool,
    client: ClientOptions,
    choice: CaseOptions,
    files: ResultOptions,
    argv: tuple[str, ...],
) -> int:
    """Test a Modbus client (master) with a server that misbehaves, one test case after another.

    \b
    fieldtwin check modbus-client --listen tcp://127.0.0.1:5020 \\
        --probe tcp://plc:502/holding:100
    fieldtwin check modbus-client --listen pty:/tmp/line --timeout 1s \\
        --probe output -- python my_client.py

    The client keeps its normal polling. A program after -- finds the endpoint in FIELDTWIN_ENDPOINT, FIELDTWIN_HOST and
    FIELDTWIN_PORT, or FIELDTWIN_TTY.

    Exit code 0 if test cases passed and none that --fail-on counts has failed, else 1.
    """
    from fieldtwin.conformance.clients.modbus.cases import CASES
    from fieldtwin.conformance.clients.session import Options, check_modbus_client

    cases = [case.about for case in CASES]
    if files.list_only:
        return files.list_cases(cases)
    if not listen:
        raise UsageError("no endpoint to listen on", expected="--listen ENDPOINT")
    plan = client.plan(choice, cases, frozenset({"echo"} if echo else ()))
    options = Options(
        Endpoint.parse(listen),
        plan,
        _words(client.values),
        client.probe,
        frozenset(client.none),
        _held(hold),
        in_ascii,
        command=argv,
    )
    return _judged(
        lambda listener: check_modbus_client(options, listener), "modbus", listen, plan, cases, choice, files
    )


@command.command("canopen-master", cls=GroupedCommand)
@group(
    "Simulated devices",
    click.option("--listen", metavar="ENDPOINT", help="can:fieldtwin/HOST:PORT (created), or can:socketcan/INTERFACE."),
    click.option("--bitrate", type=click.IntRange(10_000, 1_000_000), default=125_000, show_default=True, help="bit/s"),
    click.option(
        "--node",
        "nodes",
        multiple=True,
        type=click.IntRange(1, 127),
        help="A node that boots without a command; repeatable.",
    ),
    click.option("--heartbeat", "heartbeat_s", type=Duration(), default="1s", show_default=True, help="0: none."),
    click.option("--size", type=click.Choice(["2", "4"]), default="4", show_default=True, help="Bytes of an object."),
    click.option(
        "--hold",
        multiple=True,
        metavar="INDEX:SUB=HEX",
        help="An object's bytes as sent, such as 6041:00=3702; repeatable.",
    ),
)
@group("Client or master", client=ClientOptions)
@group("Test cases", choice=CaseOptions)
@group("Results", files=ResultOptions)
@click.argument("argv", nargs=-1, type=click.UNPROCESSED, metavar="[-- PROGRAM [ARG]...]")
def canopen_master(
    listen: str | None,
    bitrate: int,
    nodes: tuple[int, ...],
    heartbeat_s: float,
    size: str,
    hold: tuple[str, ...],
    client: ClientOptions,
    choice: CaseOptions,
    files: ResultOptions,
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
    from fieldtwin.conformance.clients.session import Options, check_canopen_master

    cases = [case.about for case in CASES]
    if files.list_only:
        return files.list_cases(cases)
    if not listen:
        raise UsageError("no endpoint to listen on", expected="--listen ENDPOINT")
    plan = client.plan(choice, cases)
    options = Options(
        Endpoint.parse(listen),
        plan,
        _words(client.values),
        client.probe,
        frozenset(client.none),
        command=argv,
        objects=_objects(hold),
        size=int(size),
        nodes=frozenset(nodes),
        heartbeat_s=heartbeat_s,
        bitrate=bitrate,
    )
    return _judged(
        lambda listener: check_canopen_master(options, listener), "canopen", listen, plan, cases, choice, files
    )


def _objects(texts: tuple[str, ...]) -> dict[tuple[int, int], bytes]:
    held = {}
    for text in texts:
        match = _OBJECT.match(text)
        if not match:
            raise UsageError("--hold", expected="such as 6041:00=3702", got=repr(text))
        held[int(match[1], 16), int(match[2], 16)] = bytes.fromhex(match[3])
    return held


def _judged(
    judge: Callable[[Listener], Coroutine[Any, Any, list[CaseResult]]],
    protocol: str,
    endpoint: str,
    plan: ClientPlan,
    cases: Sequence[ClientCase],
    choice: CaseOptions,
    files: ResultOptions,
) -> int:
    """Run the test, show the results, write the files, and return the exit code."""
    from fieldtwin.cli.test.check_view import CheckProgress
    from fieldtwin.conformance.clients.frame_log import ClientLog
    from fieldtwin.conformance.clients.results import as_json, as_report
    from fieldtwin.conformance.clients.session import Listener
    from fieldtwin.conformance.core.results import waive
    from fieldtwin.gateway.wallclock import run
    from fieldtwin.reports.conformance.client import write_client_html

    argv, title = sys.argv[1:], f"client on {endpoint}"
    words = shlex.join(["fieldtwin", *argv])
    waivers = choice.waivers(cases)
    started = datetime.now(UTC)
    began = started.isoformat(timespec="seconds")
    with ExitStack() as stack:
        log = stack.enter_context(ClientLog(files.log_path, endpoint, words)) if files.log_path else None
        progress = stack.enter_context(CheckProgress(sum(case.chosen(plan.only) for case in cases)))
        listener = Listener(progress.print_line, progress.add_result, *([log.on_event] if log is not None else []))
        found = run(judge(listener))
    results = [waive(result, waivers, started.date()) for result in found]
    about = {
        "protocol": protocol,
        "endpoint": endpoint,
        "started": began,
        "took_s": round((datetime.now(UTC) - started).total_seconds(), 3),
        "by": who(),
        "host": platform.node(),
        "command": words,
        "at_most": plan.at_most.value,
        "fieldtwin": __version__,
    }
    return files.conclude(
        results,
        as_json(about, results, argv),
        as_report(results, title, argv, began, choice.bases),
        lambda path: write_client_html(results, title, argv, began, path, choice.bases),
        choice,
    )


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
command.add_command(site)
