"""The options of `fieldtwin emulate`: for one device, for recordings, and for a whole system."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import click

from fieldtwin.cli.option_groups import option
from fieldtwin.cli.options import Secret, pairs
from fieldtwin.run.processes.field_contact import DEFAULT_CONTROL_PORT


@dataclass(frozen=True)
class OneDeviceOptions:
    """One emulated device: its endpoints, its address and its values. None: the default of its profile."""

    endpoints: tuple[str, ...] = option(
        "--on", multiple=True, metavar="ENDPOINT", help="For a device or recording: the endpoint to listen on."
    )
    unit: int | None = option(
        "--unit", type=click.IntRange(1, 247), default=None, help="For a device: its unit ID; default: the profile's."
    )
    node: int | None = option(
        "--node",
        type=click.IntRange(1, 255),
        default=None,
        help="For a CANopen device or data sheet: its node ID; 255: none yet, an LSS master assigns it.",
    )
    bitrate: int | None = option(
        "--bitrate",
        type=click.IntRange(10_000, 1_000_000),
        default=None,
        help="For a CANopen device: bit/s of the software bus; default 125000 for a new bus.",
    )
    model: str | None = option(
        "--model",
        type=click.Choice(["401", "402", "404", "406", "410", "none"]),
        default=None,
        help="For a CANopen device: the CiA profile whose model computes its objects. Default: from object 1000h.",
    )
    defaults: bool = option(
        "--defaults", is_flag=True, help="For a CANopen device: start with the DefaultValues, not with ParameterValues."
    )
    values: tuple[str, ...] = option(
        "--values",
        multiple=True,
        metavar="TAG=VALUE|FILE",
        help="For a Modbus profile: initial register values, 0 by default; no recording is replayed. FILE: a YAML mapping. "
        "Repeatable.",
    )
    faults_file: str | None = option(
        "--faults",
        type=click.Path(exists=True, dir_okay=False),
        help="For a Modbus device or recording: inject these faults (see fieldtwin faults).",
    )
    seed: int = option("--seed", type=int, default=1, help="With --faults: seed of random choices; default: 1.")
    any_unit: bool = option(
        "--any-unit",
        is_flag=True,
        help="For one Modbus device on TCP, TLS or UDP: answer to every unit ID, as some devices do.",
    )


@dataclass(frozen=True)
class RecordingOptions:
    """The recordings that are replayed, and the answers that they do not contain. `speed` 0: that of the recording."""

    recordings: tuple[str, ...] = option(
        "--recording",
        multiple=True,
        metavar="[DEVICE=]FILE",
        help="Replay this recording; for a data sheet: a log of candump -L.",
    )
    speed: float = option("--speed", type=float, default=0.0, help="Speed factor for recordings.")
    unknown: str | None = option(
        "--unknown",
        type=click.Choice(["exception", "silence", "interpolate"]),
        default=None,
        help="For a recording: the answer to a request that was not recorded. Default: exception.",
    )
    at_end: str | None = option(
        "--at-end",
        type=click.Choice(["hold", "loop", "error"]),
        default=None,
        help="For a recording: at the end of its values, hold the last one (default), begin again, or answer with exception 04.",
    )


@dataclass(frozen=True)
class SystemOptions:
    """The simulated field devices of a system: endpoints by bus, and the control channel."""

    prototype_file: Path | None = option(
        "--prototype-file",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        help="For a system: use this prototype file.",
    )
    listen: dict[str, str] = option(
        "--listen",
        multiple=True,
        metavar="BUS=ENDPOINT",
        callback=lambda ctx, parameter, values: pairs(values, "--listen"),
        help="For a system: endpoint for the emulators of a bus.",
    )
    control: str = option(
        "--control",
        default=f"127.0.0.1:{DEFAULT_CONTROL_PORT}",
        show_default=True,
        metavar="HOST:PORT",
        help="For a system: control address, for `fieldtwin run --field`.",
    )
    token: str = option(
        "--token",
        type=Secret(),
        default="",
        metavar="@FILE",
        help="Token that --control requires from its clients; needed if not on loopback. Or FIELDTWIN_EMULATE_TOKEN.",
    )
    instance: str = option(
        "--instance", default="", help="Name of the run directory; default: the system's name and -field."
    )
