"""The options of commands that query one device: its endpoint, its profile, and the log of sent frames."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import click

from fieldtwin.cli.options import Duration, profiles_option
from fieldtwin.commissioning.access.address import ORDERS, TYPES, RawForm
from fieldtwin.commissioning.access.frame_log import FrameLog
from fieldtwin.commissioning.access.reading import Target, target_of
from fieldtwin.gateway.core.connection import Tap
from fieldtwin.gateway.core.errors import UsageError

F = TypeVar("F", bound=Callable[..., Any])

_DEVICE = (
    click.option("--unit", type=click.IntRange(0, 255), help="Modbus unit ID; default: the profile's, else 1."),
    click.option("--node", type=click.IntRange(1, 127), help="CANopen node ID; default: the profile's, else 1."),
    click.option(
        "--profile", "profile_name", default="", metavar="NAME", help="A device profile, which defines tags by name."
    ),
    click.option(
        "--eds", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="CANopen: the device's EDS or DCF."
    ),
    click.option(
        "--bitrate", type=click.IntRange(10_000, 1_000_000), help="CAN: bit rate in bit/s; default: the bus's."
    ),
    click.option(
        "--timeout", "timeout_s", type=Duration(), default="1s", show_default=True, help="Timeout for each reply."
    ),
    click.option("--echo", is_flag=True, help="Serial: the adapter echoes the sent bytes."),
    click.option(
        "--log",
        type=click.Path(dir_okay=False, path_type=Path),
        help="Append all sent and received frames to this file.",
    ),
    profiles_option,
)
_RAW = (
    click.option("--type", "kind", type=click.Choice(TYPES), help="Type of raw addresses; default: uint16, for bits bool."),
    click.option("--order", type=click.Choice(ORDERS, case_sensitive=False), default="ABCD", show_default=True,
                 help="Byte order of raw values longer than a register."),
    click.option("--count", type=click.IntRange(1, 2000), default=1, help="Number of values from each raw address on."),
    click.option("--registers", type=click.IntRange(1, 125), default=1, help="Length of a raw string or of bytes."),
)  # fmt: skip


def device_options(command: F) -> F:
    """Add the options for ENDPOINT's device: its unit or node ID, profile, bit rate, timeout and log."""
    for option in reversed(_DEVICE):
        command = option(command)
    return command


def raw_options(command: F) -> F:
    """Add the options that decode raw addresses: --type, --order, --count, --registers."""
    for option in reversed(_RAW):
        command = option(command)
    return command


def target_from(endpoint: str, options: dict[str, Any]) -> Target:
    """Return the device that the options describe. Raises `UsageError`, `FileInvalid`."""
    unit, node = options["unit"], options["node"]
    if endpoint.lower().startswith("can:"):
        if unit is not None:
            raise UsageError("a CANopen device has a node id", expected="--node", got="--unit")
    elif node is not None:
        raise UsageError("a Modbus device has a unit id", expected="--unit", got="--node")
    return target_of(
        endpoint,
        address=node if unit is None else unit,
        profile_name=options["profile_name"],
        eds=options["eds"],
        folders=options["profiles"],
        bitrate=options["bitrate"] or 0,
        timeout_s=options["timeout_s"],
        echo=options["echo"],
    )


def raw_form(options: dict[str, Any]) -> RawForm:
    """Return how raw addresses are decoded."""
    return RawForm(options["kind"], options["order"].upper(), options["count"], options["registers"])


def words() -> str:
    """Return this command line, for a log."""
    return shlex.join(["fieldtwin", *sys.argv[1:]])


@contextmanager
def logged(path: Path | None) -> Iterator[list[Tap]]:
    """Return the taps of a command: the log at `path`, or none."""
    if path is None:
        yield []
        return
    with FrameLog(path, words()) as log:
        yield [log]
