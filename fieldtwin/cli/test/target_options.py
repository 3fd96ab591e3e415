"""The options of `fieldtwin test` for the place where scenarios run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import click

from fieldtwin.cli.option_groups import option
from fieldtwin.cli.options import Secret
from fieldtwin.conformance.core.case import Impact


@dataclass(frozen=True)
class TargetOptions:
    """The target on which scenarios run, with the options of each kind of target."""

    target: str = option(
        "--target",
        type=click.Choice(["virtual", "local", "compose", "real"]),
        default="virtual",
        show_default=True,
        help="Where to run: virtual time, processes on this host, containers, a plant.",
    )
    can: str = option(
        "--can",
        default="",
        metavar="INTERFACE/CHANNEL",
        help="With local: emulate CAN buses on this interface, such as socketcan/vcan0.",
    )
    with_command: bool = option(
        "--with",
        is_flag=True,
        help="With local: CMD after -- controls instead of our gateway and PLC, in the environment of `fieldtwin with`.",
    )
    instance: str = option(
        "--instance", default="", help="With compose, real: name of the running instance on this host."
    )
    field_host: str = option(
        "--field", default="", metavar="HOST[:PORT]", help="With compose: address of the field simulator."
    )
    token: str = option(
        "--token",
        type=Secret(),
        default="",
        metavar="@FILE",
        help="Token of that simulator's control channel; or FIELDTWIN_TEST_TOKEN.",
    )
    far: str = option(
        "--far", default="", metavar="ENDPOINT", help="With real: endpoint of the topside modem, for `send`."
    )
    capture: Path | None = option(
        "--capture",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        help="With --instance: the file with its captured traffic.",
    )
    allow: str = option(
        "--allow",
        type=click.Choice([impact.value for impact in Impact]),
        default=Impact.READ.value,
        show_default=True,
        help="With --target real: highest impact level of steps.",
    )
