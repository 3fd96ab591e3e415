"""`fieldtwin check modbus` and `fieldtwin check canopen`: conformance tests of third-party devices."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import click

from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import Duration
from fieldtwin.cli.test.check_device import CareOptions, DeviceCheck
from fieldtwin.cli.test.check_options import CaseOptions, ResultOptions
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError

_CELL = re.compile(r"^(holding|coil|input|discrete):(0[xX][0-9A-Fa-f]{1,4}|\d{1,5})(?:\+(\d{1,3}))?$")
_OBJECT = re.compile(r"^([0-9A-Fa-f]{4})h?(?::([0-9A-Fa-f]{1,2}))?$")


@click.command("modbus", cls=GroupedCommand)
@click.argument("endpoint", required=False)
@group(
    "Device",
    click.option("--unit", type=click.IntRange(0, 255), default=1, show_default=True, help="Unit ID of the device."),
    click.option(
        "--read",
        "reads",
        multiple=True,
        metavar="TABLE:ADDRESS",
        help="A readable register or bit, such as holding:100 or holding:0x163, if none is near 0, 1, 100, 1000, 40000; "
        "repeatable.",
    ),
    click.option(
        "--write",
        "writes",
        multiple=True,
        metavar="TABLE:ADDRESS[+COUNT]",
        help="A cell that may be written, holding or coil, also in hexadecimal; its value is restored afterwards. Repeatable.",
    ),
    click.option(
        "--timeout", "timeout_s", type=Duration(), default="1s", show_default=True, help="Timeout for each reply."
    ),
    click.option("--echo", is_flag=True, help="The adapter echoes the sent bytes."),
    click.option("--share-bus", is_flag=True, help="Also run on a line that carries other traffic."),
)
@group("Limits", care=CareOptions)
@group("Test cases", choice=CaseOptions)
@group("Results", files=ResultOptions)
def modbus(
    endpoint: str | None,
    unit: int,
    reads: tuple[str, ...],
    writes: tuple[str, ...],
    timeout_s: float,
    echo: bool,
    share_bus: bool,
    care: CareOptions,
    choice: CaseOptions,
    files: ResultOptions,
) -> int:
    """Test a Modbus device: all test cases of the list that a client can run.

    \b
    fieldtwin check modbus tcp://192.0.2.7:502 --unit 1 --html unit1.html
    fieldtwin check modbus 'rtu:/dev/ttyUSB0?baudrate=9600&frame=8N1' --unit 17
    fieldtwin check modbus tcp://192.0.2.7:502 --write holding:100 --dry-run

    By default it sends only reads. Exit code 0 if test cases passed and none that --fail-on counts has failed, else 1.
    """
    from fieldtwin.conformance.devices.dry_run import modbus_dry_run
    from fieldtwin.conformance.devices.modbus.cases import CASES
    from fieldtwin.conformance.devices.modbus.session import ModbusOptions, check_modbus, traits_of

    if files.list_only:
        return files.list_cases(CASES)
    if not endpoint:
        raise UsageError("no device to check", expected="an endpoint such as tcp://192.0.2.7:502")
    traits = traits_of(Endpoint.parse(endpoint))
    may_write = {table: (at, count) for table, at, count in map(_cell, writes)}
    if set(may_write) - {"holding", "coil"}:
        raise UsageError("--write", expected="holding:ADDRESS or coil:ADDRESS", got=", ".join(writes))
    check = DeviceCheck("modbus", endpoint, unit, care, choice, files)
    plan = check.plan(CASES, set(may_write), bool(writes))
    to_do = ModbusOptions(
        endpoint, unit, plan, timeout_s, 1 / care.rate, echo, share_bus=share_bus,
        given={table: at for table, at, _ in map(_cell, reads)}, may_write=may_write,
    )  # fmt: skip
    dry_run_result = modbus_dry_run(to_do)
    if care.dry_run:
        return check.print_dry_run(dry_run_result)
    check.ask(CASES, plan, traits)
    check.estimate(dry_run_result)
    began = datetime.now(UTC)
    checked = check.play(
        len([c for c in CASES if c.chosen(plan.only)]),
        lambda taps, go_on, print_line, on_result: check_modbus(replace(to_do, taps=taps, go_on=go_on), print_line, on_result),
    )  # fmt: skip
    return check.done(check.subject(checked, plan, began, writes, timeout_s), checked)


@click.command("canopen", cls=GroupedCommand)
@click.argument("endpoint", required=False)
@group(
    "Device",
    click.option("--node", type=click.IntRange(1, 127), help="Node ID of the device."),
    click.option(
        "--eds",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        help="Its data sheet (EDS or DCF), for limits and access rights.",
    ),
    click.option(
        "--bitrate", type=click.IntRange(10_000, 1_000_000), help="Bit rate in bit/s, if the bus does not define it."
    ),
    click.option(
        "--write",
        "writes",
        multiple=True,
        metavar="INDEX:SUB",
        help="An object that may be written, such as 2000:00 or 1017:00; its value is restored afterwards. Repeatable.",
    ),
    click.option(
        "--timeout",
        "timeout_s",
        type=Duration(),
        default="500ms",
        show_default=True,
        help="Timeout for each SDO reply.",
    ),
    click.option(
        "--boot",
        "boot_s",
        type=Duration(),
        default="10s",
        show_default=True,
        help="Timeout for the boot-up after a reset.",
    ),
    click.option("--share-bus", is_flag=True, help="Also run on a node that another master uses over SDO."),
)
@group("Limits", care=CareOptions)
@group("Test cases", choice=CaseOptions)
@group("Results", files=ResultOptions)
def canopen(
    endpoint: str | None,
    node: int | None,
    eds: Path | None,
    bitrate: int | None,
    writes: tuple[str, ...],
    timeout_s: float,
    boot_s: float,
    share_bus: bool,
    care: CareOptions,
    choice: CaseOptions,
    files: ResultOptions,
) -> int:
    """Test a CANopen node: all test cases of the list that a master can run.

    \b
    fieldtwin check canopen can:socketcan/can0 --node 5 --eds inclinometer.eds
    fieldtwin check canopen can:fieldtwin/127.0.0.1:29536 --node 5 --write 1017:00

    By default it sends only uploads. Exit code 0 if test cases passed and none that --fail-on counts has failed, else 1.
    """
    from fieldtwin.conformance.devices.canopen.cases import CASES
    from fieldtwin.conformance.devices.canopen.session import CanopenOptions, check_canopen
    from fieldtwin.conformance.devices.dry_run import canopen_dry_run

    if files.list_only:
        return files.list_cases(CASES)
    if not endpoint or node is None:
        raise UsageError("no node to check", expected="an endpoint such as can:socketcan/can0, and --node")
    if not Endpoint.parse(endpoint).is_can:
        raise UsageError("CANopen needs a CAN bus", expected="such as can:socketcan/can0", got=endpoint)
    may_write = tuple(_object(text) for text in writes)
    check = DeviceCheck("canopen", endpoint, node, care, choice, files)
    has = ({"object"} if may_write else set()) | ({"eds"} if eds is not None else set())
    plan = check.plan(CASES, has, bool(writes))
    to_do = CanopenOptions(
        endpoint, node, plan, bitrate or 0, timeout_s, 1 / care.rate, boot_s, eds, share_bus, may_write
    )
    dry_run_result = canopen_dry_run(to_do)
    if care.dry_run:
        return check.print_dry_run(dry_run_result)
    check.ask(CASES, plan, frozenset({"can"}))
    check.estimate(dry_run_result)
    began = datetime.now(UTC)
    checked = check.play(
        len([c for c in CASES if c.chosen(plan.only)]),
        lambda taps, go_on, print_line, on_result: check_canopen(replace(to_do, taps=taps, go_on=go_on), print_line, on_result),
    )  # fmt: skip
    return check.done(check.subject(checked, plan, began, writes, timeout_s), checked)


def _object(text: str) -> tuple[int, int]:
    match = _OBJECT.match(text)
    if not match:
        raise UsageError("an object", expected="index and subindex in hex, such as 2000:00", got=repr(text))
    return int(match[1], 16), int(match[2] or "0", 16)


def _cell(text: str) -> tuple[str, int, int]:
    match = _CELL.match(text)
    address = -1 if not match else int(match[2], 16 if match[2][:2].lower() == "0x" else 10)
    if not match or address > 0xFFFF or address + int(match[3] or 1) > 0x10000 or match[3] == "0":
        raise UsageError(
            "a cell",
            expected="such as holding:100, holding:0x163 or coil:5, with +COUNT after it if need be",
            got=repr(text),
        )
    return match[1], address, int(match[3] or 1)
