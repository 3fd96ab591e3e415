"""The options of commands that query one device: its endpoint, its profile, and the log of sent frames."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import click

from fieldtwin.cli.option_groups import option
from fieldtwin.cli.options import PROFILES, Duration
from fieldtwin.commissioning.access.address import ORDERS, TYPES, RawForm
from fieldtwin.commissioning.access.frame_log import FrameLog
from fieldtwin.commissioning.access.reading import DeviceTarget, target_of
from fieldtwin.gateway.core.connection import Tap
from fieldtwin.gateway.core.errors import UsageError


@dataclass(frozen=True)
class DeviceOptions:
    """The options for one device at an endpoint: its unit or node ID, profile, bit rate and timeout. None: the default."""

    unit: int | None = option(
        "--unit", type=click.IntRange(0, 255), help="Modbus unit ID; default: the profile's, else 1."
    )
    node: int | None = option(
        "--node", type=click.IntRange(1, 127), help="CANopen node ID; default: the profile's, else 1."
    )
    profile_name: str = option(
        "--profile", default="", metavar="NAME", help="A device profile, which defines tags by name."
    )
    eds: Path | None = option(
        "--eds", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="CANopen: the device's EDS or DCF."
    )
    bitrate: int | None = option(
        "--bitrate", type=click.IntRange(10_000, 1_000_000), help="CAN: bit rate in bit/s; default: the bus's."
    )
    timeout_s: float = option(
        "--timeout", type=Duration(), default="1s", show_default=True, help="Timeout for each reply."
    )
    echo: bool = option("--echo", is_flag=True, help="Serial: the adapter echoes the sent bytes.")
    profiles: tuple[Path, ...] = option("--profiles", **PROFILES)

    def target(self, endpoint: str) -> DeviceTarget:
        """Return the device at `endpoint`. Raises `UsageError`, `FileInvalid`."""
        if endpoint.lower().startswith("can:"):
            if self.unit is not None:
                raise UsageError("a CANopen device has a node id", expected="--node", got="--unit")
        elif self.node is not None:
            raise UsageError("a Modbus device has a unit id", expected="--unit", got="--node")
        return target_of(
            endpoint,
            address=self.node if self.unit is None else self.unit,
            profile_name=self.profile_name,
            eds=self.eds,
            folders=self.profiles,
            bitrate=self.bitrate or 0,
            timeout_s=self.timeout_s,
            echo=self.echo,
        )


@dataclass(frozen=True)
class RawOptions:
    """The options that state how values at raw addresses are decoded."""

    kind: str | None = option(
        "--type", type=click.Choice(TYPES), help="Type of raw addresses; default: uint16, for bits bool."
    )
    order: str = option(
        "--order",
        type=click.Choice(ORDERS, case_sensitive=False),
        default="ABCD",
        show_default=True,
        help="Byte order of raw values longer than a register.",
    )
    count: int = option(
        "--count", type=click.IntRange(1, 2000), default=1, help="Number of values from each raw address on."
    )
    registers: int = option(
        "--registers", type=click.IntRange(1, 125), default=1, help="Length of a raw string or of bytes."
    )

    @property
    def form(self) -> RawForm:
        return RawForm(self.kind, self.order.upper(), self.count, self.registers)


log_option = click.option(
    "--log", type=click.Path(dir_okay=False, path_type=Path), help="Append all sent and received frames to this file."
)
frames_option = click.option("--dry-run", is_flag=True, help="Print the frames that would be sent; send nothing.")


def words() -> str:
    """Return the command line of this process, for a log."""
    return shlex.join(["fieldtwin", *sys.argv[1:]])


@contextmanager
def logged(path: Path | None) -> Iterator[list[Tap]]:
    """Yield the observers of a command's frames: the log at `path`, or none."""
    if path is None:
        yield []
        return
    with FrameLog(path, words()) as log:
        yield [log]
