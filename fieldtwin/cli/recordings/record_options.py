"""The options of `fieldtwin record`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import click

from fieldtwin.cli.option_groups import option
from fieldtwin.cli.options import Duration


@dataclass(frozen=True)
class RecordingSourceOptions:
    """The options for a recording that does not poll a device by the tags of its profile."""

    taps: tuple[str, str] | None = option(
        "--tap", nargs=2, metavar="A B", help="Connect a client (A) with its devices (B), and record all traffic."
    )
    sniff: str | None = option(
        "--sniff",
        metavar="PORT",
        help="Listen with one adapter to a serial line between other devices; nothing is sent.",
    )
    like: Path | None = option(
        "--like",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        help="Repeat the reads of this recording, instead of reading the tags of a profile.",
    )
    as_scenario: str = option(
        "--as-scenario",
        default="",
        metavar="SYSTEM",
        help="ENDPOINT is a run of SYSTEM (--trace, --capture): make a scenario of it, with tolerances.",
    )


@dataclass(frozen=True)
class PollOptions:
    """The options for the polling rounds, and for the end of a recording. None: no limit."""

    groups: tuple[str, ...] = option("--group", multiple=True, help="With a Modbus profile: only this poll group.")
    every_s: float = option(
        "--every", type=Duration(), default="1s", show_default=True, help="Period of the polling rounds."
    )
    rounds: int | None = option(
        "--rounds", type=click.IntRange(1), default=None, help="Stop after this number of rounds."
    )
    for_s: float | None = option(
        "--for", type=Duration(), default=None, help="Stop after this time; default: at Ctrl-C."
    )
    spacing_s: float = option("--spacing", type=Duration(), default="0s", help="Pause after every exchange.")
    dry_run: bool = option("--dry-run", is_flag=True, help="Print the frames that a round would send; send nothing.")


@dataclass(frozen=True)
class FileOptions:
    """The options for the file of a recording and the parts into which it is split. None: no limit."""

    out: Path = option(
        "-o",
        "--out",
        type=click.Path(dir_okay=False, path_type=Path),
        required=True,
        help="The recording: NAME.jsonl, for a CAN bus NAME.log. An existing file is never changed.",
    )
    part_mb: int = option(
        "--part-size",
        type=click.IntRange(1),
        default=256,
        show_default=True,
        help="Maximum size of a part of the file, in MB.",
    )
    part_s: float | None = option(
        "--part-time", type=Duration(), default=None, help="Begin a new part after this time, such as 1h."
    )
    keep: int | None = option(
        "--keep", type=click.IntRange(1), default=None, help="Keep this number of parts; the oldest are removed."
    )
    emulated: bool = option("--emulated", is_flag=True, help="Mark the recording as one of an emulator.")
