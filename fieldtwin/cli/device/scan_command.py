"""`fieldtwin scan`: find the devices on a bus."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import click

from fieldtwin.cli.device.device_options import log_option, logged
from fieldtwin.cli.device.scan_progress import ScanProgress, duration
from fieldtwin.cli.device.scan_view import can_json, modbus_json, show_can, show_modbus
from fieldtwin.cli.option_groups import GroupedCommand, group, option
from fieldtwin.cli.options import Duration, json_option
from fieldtwin.cli.stop_key import StopKey
from fieldtwin.commissioning.access.connection import frame_of
from fieldtwin.commissioning.scan.canopen import ALL_NODES, CanScan, CanScanner, CanScanOptions
from fieldtwin.commissioning.scan.modbus import ModbusScan, ModbusScanner, ScanOptions
from fieldtwin.commissioning.scan.settings import name_of, seconds_of, with_settings
from fieldtwin.commissioning.scan.sweep import PROBE
from fieldtwin.console import stderr
from fieldtwin.gateway.connections.serial.port import is_pty
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.wallclock import run as run_precise

INTERRUPTED = 130
_PART = re.compile(r"^([0-9]{1,3})(?:-([0-9]{1,3}))?$")


@dataclass(frozen=True)
class SearchOptions:
    """The units, nodes and settings to search. None: the default for the protocol."""

    units: str | None = option(
        "--units", metavar="LIST", help="Modbus unit IDs, such as 1-20,247; default 1 to 247, on TCP also 0 and 255."
    )
    nodes: str | None = option("--nodes", metavar="LIST", help="CANopen node IDs; default 1 to 127.")
    quick: bool = option("--quick", is_flag=True, help="Modbus: only the likely settings and units (30 s).")
    every_setting: bool = option("--all", is_flag=True, help="Modbus: try all settings, even after units were found.")
    no_lss: bool = option("--no-lss", is_flag=True, help="CAN: do not search for nodes without a node ID.")


@dataclass(frozen=True)
class BusOptions:
    """How long the scan listens, and how fast it sends. None: the default for the protocol."""

    listen_only: bool = option("--listen", is_flag=True, help="Only listen: send nothing.")
    listen_for: float | None = option(
        "--listen-for", type=Duration(), help="How long to listen first; default 3s, on CAN 5s."
    )
    share_bus: bool = option(
        "--share-bus", is_flag=True, help="Send although the bus carries traffic: between its exchanges."
    )
    timeout_s: float | None = option(
        "--timeout", type=Duration(), help="Timeout for each reply; default 600ms, TCP 1s, CAN 100ms."
    )
    per_s: float | None = option(
        "--rate", type=click.FloatRange(0.1, 1000), help="Maximum requests per second; default 20, CAN 10."
    )
    bitrate: int | None = option(
        "--bitrate", type=click.IntRange(10_000, 1_000_000), help="CAN: expected bit rate of the bus, in bit/s."
    )


@click.command("scan", cls=GroupedCommand)
@click.argument("endpoint")
@group("Search", search=SearchOptions)
@group("Bus", bus=BusOptions)
@group(
    "Output",
    log_option,
    click.option("--dry-run", is_flag=True, help="Print the requests and their duration; open nothing."),
    json_option,
)
def command(
    endpoint: str, search: SearchOptions, bus: BusOptions, log: Path | None, dry_run: bool, as_json: bool
) -> int:
    """Find the units or nodes at ENDPOINT: listen first, then ask at a limited rate.

    \b
    Serial line: the likely settings first, then all:
      fieldtwin scan rtu:/dev/ttyUSB0
    Serial line: every unit with these settings:
      fieldtwin scan 'rtu:COM5?baudrate=9600&frame=8N1'
    Every unit ID of a host:
      fieldtwin scan tcp://192.168.0.7
    CAN: heartbeats, object 1000h, LSS:
      fieldtwin scan can:socketcan/can0

    q or Ctrl-C stops the scan and keeps its results. Exit code 1: no device was found.
    """
    can = Endpoint.parse(endpoint).is_can
    _refuse_foreign(can, search, bus)
    if dry_run:
        for line in _plan_of_can(search, bus) if can else _plan_of_modbus(endpoint, search, bus):
            click.echo(line)
        return 0
    return (_can if can else _modbus)(endpoint, search, bus, log, as_json)


def _modbus(endpoint: str, search: SearchOptions, bus: BusOptions, log: Path | None, as_json: bool) -> int:
    result = run_precise(_scan_modbus(endpoint, search, bus, log))
    if as_json:
        click.echo(json.dumps(modbus_json(result)))
    else:
        show_modbus(result)
        if result.units and is_pseudo_terminal(Endpoint.parse(endpoint)):
            stderr.print(
                "this port is a pseudo-terminal, which passes bytes at every baud rate: the settings above are not confirmed",
                soft_wrap=True,
            )
    found = bool(result.units or (result.heard is not None and result.heard.live))
    return _end(found, result.stopped, result.took_s)


def is_pseudo_terminal(endpoint: Endpoint) -> bool:
    """Return whether the port is a pseudo-terminal, as `socat` and `fieldtwin emulate` make one."""
    return endpoint.is_serial and is_pty(endpoint.path)


def _can(endpoint: str, search: SearchOptions, bus: BusOptions, log: Path | None, as_json: bool) -> int:
    result = run_precise(_scan_can(endpoint, search, bus, log))
    if as_json:
        click.echo(json.dumps(can_json(result)))
    else:
        show_can(result)
    found = bool(result.nodes or result.unconfigured or result.heard.nodes)
    return _end(found, result.stopped, result.took_s)


def _end(found: bool, stopped: bool, took_s: float) -> int:
    if stopped:
        stderr.print(f"stopped after {duration(took_s)}: the list is not complete")
        return INTERRUPTED
    return 0 if found else 1


def _plan_of_modbus(endpoint: str, search: SearchOptions, bus: BusOptions) -> Iterator[str]:
    """Yield lines with the phases, settings and frames of the scan, for `--dry-run`."""
    made = _modbus_options(search, bus)
    if Endpoint.parse(endpoint).is_serial:
        yield f"listen for {duration(made.listen_s)}; if there is traffic, nothing is sent" + (
            ", but between its exchanges" if made.share_bus else " without --share-bus"
        )
    for phase, steps in ModbusScanner(endpoint, made).planned() if not made.listen_only else ():
        yield f"{phase}: up to {duration(seconds_of(steps))}"
        for step in steps:
            url = str(with_settings(Endpoint.parse(endpoint), step.settings)) if step.settings else endpoint
            first, last = (frame_of(url, step.units[i], PROBE).hex(" ") for i in (0, -1)) if step.units else ("", "")
            where = f"{name_of(step.settings)}, " if step.settings else ""
            yield f"  {where}{len(step.units)} units: {first} ... {last}"


def _plan_of_can(search: SearchOptions, bus: BusOptions) -> Iterator[str]:
    made = _can_options(search, bus)
    yield f"listen for {duration(made.listen_s)}; if there is traffic, nothing is sent" + (
        "" if made.share_bus else " without --share-bus"
    )
    if not made.listen_only:
        each_s = max(made.timeout_s + 0.01, 1 / made.per_s)
        yield f"1000h of {len(made.nodes)} nodes: up to {duration(len(made.nodes) * each_s)}"
        yield f"  {0x600 + made.nodes[0]:03X}#4000100000000000 ... {0x600 + made.nodes[-1]:03X}#4000100000000000"
        if made.lss:
            yield "nodes without a node ID: 7E5#4C00000000000000, then LSS fastscan, 14 s for each one found"


async def _scan_modbus(endpoint: str, search: SearchOptions, bus: BusOptions, log: Path | None) -> ModbusScan:
    made = _modbus_options(search, bus)
    with logged(log) as taps, StopKey() as stop, ScanProgress(stop.listens) as show:
        return await ModbusScanner(endpoint, made, on_progress=show, stop=stop.pressed, taps=taps).run()


async def _scan_can(endpoint: str, search: SearchOptions, bus: BusOptions, log: Path | None) -> CanScan:
    made = _can_options(search, bus)
    with logged(log) as taps, StopKey() as stop, ScanProgress(stop.listens) as show:
        return await CanScanner(endpoint, made, on_progress=show, stop=stop.pressed, taps=taps).run()


def _modbus_options(search: SearchOptions, bus: BusOptions) -> ScanOptions:
    return ScanOptions(
        units=numbers(search.units, 0, 255, "--units"),
        timeout_s=bus.timeout_s,
        per_s=bus.per_s or 20.0,
        listen_s=3.0 if bus.listen_for is None else bus.listen_for,
        quick_only=search.quick,
        listen_only=bus.listen_only,
        every_setting=search.every_setting,
        share_bus=bus.share_bus,
    )


def _can_options(search: SearchOptions, bus: BusOptions) -> CanScanOptions:
    return CanScanOptions(
        bitrate=bus.bitrate or 0,
        nodes=numbers(search.nodes, 1, 127, "--nodes") or ALL_NODES,
        listen_s=5.0 if bus.listen_for is None else bus.listen_for,
        timeout_s=bus.timeout_s or 0.1,
        per_s=bus.per_s or 10.0,
        lss=not search.no_lss,
        listen_only=bus.listen_only,
        share_bus=bus.share_bus,
    )


def numbers(text: str | None, low: int, high: int, name: str) -> tuple[int, ...] | None:
    """Return the numbers in a text such as ``1-20,247``, without duplicates, in ascending order. Raises `UsageError`."""
    if text is None:
        return None
    found: list[int] = []
    for part in text.split(","):
        match = _PART.match(part.strip())
        first = int(match[1]) if match else -1
        last = int(match[2] or match[1]) if match else -1
        if not low <= first <= last <= high:
            raise UsageError(f"cannot read {name}", expected=f"{low} to {high}, such as 1-20,47", got=repr(text))
        found += range(first, last + 1)
    return tuple(dict.fromkeys(found))


def _refuse_foreign(can: bool, search: SearchOptions, bus: BusOptions) -> None:
    """Raise `UsageError` for options of the other protocol."""
    of_modbus = {"--units": search.units, "--quick": search.quick, "--all": search.every_setting}
    of_can = {"--nodes": search.nodes, "--bitrate": bus.bitrate, "--no-lss": search.no_lss}
    given = [name for name, value in (of_modbus if can else of_can).items() if value]
    if given:
        raise UsageError(f"{', '.join(given)}: not {'on a CAN bus' if can else 'of Modbus'}")
