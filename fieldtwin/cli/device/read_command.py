"""`fieldtwin read`: read values of one device once."""

from __future__ import annotations

import json
from pathlib import Path

import click

from fieldtwin.cli.device.device_options import DeviceOptions, RawOptions, frames_option, log_option, logged
from fieldtwin.cli.device.value_table import exit_code, value_table
from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import json_option
from fieldtwin.commissioning.access.address import tags_of
from fieldtwin.commissioning.access.point import PointValue
from fieldtwin.commissioning.access.reading import DeviceTarget, dry_point, read_all, row_of
from fieldtwin.console import stdout
from fieldtwin.gateway.core.errors import NotAllowed
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.wallclock import run as run_precise


@click.command("read", cls=GroupedCommand)
@click.argument("endpoint")
@click.argument("items", nargs=-1, metavar="[ITEM]...")
@group("Device", device=DeviceOptions)
@group("Raw addresses", raw=RawOptions)
@group("Output", log_option, frames_option, json_option)
def command(
    endpoint: str,
    items: tuple[str, ...],
    device: DeviceOptions,
    raw: RawOptions,
    log: Path | None,
    dry_run: bool,
    as_json: bool,
) -> int:
    """Read ITEMs of the device at ENDPOINT: tags of a profile, or addresses; by default all tags of the profile.

    If an item cannot be read, the table shows the reason, and the other items are read all the same. Exit code: 0 if every
    item was read, 4 if a reply was lost, else 5 if the device refused an item.

    \b
    fieldtwin read tcp://192.168.0.7 holding:100 --count 4
    fieldtwin read 'rtu:/dev/ttyUSB0?baudrate=9600&frame=8N1' \\
        40101 --type float32 --order CDAB
    fieldtwin read rtu:/dev/ttyUSB0 --profile eastron-sdm630 \\
        'voltage_*' frequency
    fieldtwin read can:socketcan/can0 --node 5 6041h:00 1018h:01 --count 4
    """
    target = device.target(endpoint)
    tags = tags_of(items, target.protocol, raw.form, target.profile, target.dictionary)
    readable = [t for t in tags if t.readable]
    if not readable:
        raise NotAllowed(f"cannot be read: {', '.join(t.name for t in tags)}", hint="the profile says `access: wo`")
    if dry_run:
        for frame in dry_point(target).read_frames(readable):
            click.echo(frame)
        return 0
    answers = run_precise(_read(target, tags, log))
    if as_json:
        rows = [row_of(t, answers[t.name]) for t in tags]
        click.echo(json.dumps({"endpoint": target.url, "address": target.address, "values": rows}))
    else:
        stdout.print(value_table(tags, answers))
    return exit_code(answers.values())


async def _read(target: DeviceTarget, tags: list[Tag], log: Path | None) -> dict[str, PointValue]:
    with logged(log) as taps:
        return await read_all(target, tags, taps=taps)
