"""`fieldtwin write`: write values of one device, after a confirmation, and read them back."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
from rich.text import Text

from fieldtwin.cli.device.device_options import DeviceOptions, RawOptions, log_option, logged
from fieldtwin.cli.option_groups import GroupedCommand, group, option
from fieldtwin.cli.options import Duration, json_option
from fieldtwin.commissioning.access import writing
from fieldtwin.commissioning.access.address import of_behaviour, tags_of, with_care
from fieldtwin.commissioning.access.connection import frame_of, modbus_at
from fieldtwin.commissioning.access.point import Point, PointValue, decoded
from fieldtwin.commissioning.access.reading import DeviceTarget, dry_point, point_at, text_of
from fieldtwin.commissioning.access.writing import Write, Written
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.errors import FieldtwinError, NotAllowed, ReplyTimeout, UsageError
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.protocols.modbus.requests.diagnostics import Diagnostics
from fieldtwin.gateway.wallclock import run as run_precise

RESTART_COMMUNICATIONS = 1


@dataclass(frozen=True)
class WriteOptions:
    """The options for more writes at once, the confirmation, and the restoring of old values after `hold_s` seconds."""

    behaviours: tuple[str, ...] = option(
        "--behaviour", multiple=True, metavar="NAME", help="Make the named writes of the profile (`behaviours`)."
    )
    restart: bool = option(
        "--restart-communications", is_flag=True, help="Modbus: send function 08h/01h (restart) instead of a value."
    )
    restore: bool = option("--restore", is_flag=True, help="Restore the old values afterwards.")
    hold_s: float = option(
        "--hold", type=Duration(), default="0s", help="With --restore: time before the old values are restored."
    )
    blind: bool = option("--blind", is_flag=True, help="Write even if the old value cannot be read.")
    yes: bool = option("--yes", is_flag=True, help="Do not ask.")
    i_know: bool = option(
        "--i-know", is_flag=True, help="Permit writes with wider effects: unit 0, `danger` tags, restarts."
    )
    dry_run: bool = option("--dry-run", is_flag=True, help="Print the frames that would be sent; send nothing.")


@click.command("write", cls=GroupedCommand)
@click.argument("endpoint")
@click.argument("items", nargs=-1, metavar="ITEM=VALUE...")
@group("Device", device=DeviceOptions)
@group("Raw addresses", raw=RawOptions)
@group("Write", how=WriteOptions)
@group("Output", log_option, json_option)
def command(
    endpoint: str,
    items: tuple[str, ...],
    device: DeviceOptions,
    raw: RawOptions,
    how: WriteOptions,
    log: Path | None,
    as_json: bool,
) -> int:
    """Write ITEMs of the device at ENDPOINT: read, ask for confirmation, write once, read back, compare.

    VALUE is a number, a name that the profile defines for a number, on/off, or hex:BYTES. Ctrl-C during --hold restores the
    old values.

    \b
    fieldtwin write tcp://192.168.0.7 holding:100=42
    fieldtwin write rtu:/dev/ttyUSB0 --profile eastron-sdm630 \\
        demand_period=15 --yes
    fieldtwin write can:socketcan/can0 --node 5 6060h:00=1 --type int8 \\
        --restore --hold 10s
    fieldtwin write can:socketcan/can0 --node 5 --profile drive-cia402 \\
        --behaviour quick_stop
    """
    target = device.target(endpoint)
    items = (*(item for name in how.behaviours for item in of_behaviour(name, target.profile)), *items)
    if how.restart:
        return _restart(target, items, log, i_know=how.i_know, yes=how.yes, dry_run=how.dry_run)
    writes = writing.plan_writes(_pairs(items, target, raw), i_know=how.i_know, restore=how.restore)
    dry = dry_point(target)
    writing.check_broadcast(dry, i_know=how.i_know)
    if how.dry_run:
        for write in writes:
            for frame in dry.write_frames(write.tag, write.data):
                click.echo(frame)
        return 0
    if not how.yes and not sys.stdin.isatty():
        raise NotAllowed("there is no terminal to confirm the write", expected="--yes")
    hold_s = how.hold_s if how.restore else None
    done = run_precise(_write(target, writes, log, yes=how.yes, hold_s=hold_s, blind=how.blind))
    if as_json:
        click.echo(json.dumps([_row(w) for w in done]))
    else:
        for written in done:
            stdout.print(_told(written))
    return 0


def _pairs(items: tuple[str, ...], target: DeviceTarget, raw: RawOptions) -> list[tuple[Tag, str]]:
    if not items:
        raise UsageError("nothing to write", expected="ITEM=VALUE, such as holding:100=42")
    pairs: list[tuple[Tag, str]] = []
    for item in items:
        name, equals, value = item.partition("=")
        if not equals or not value:
            raise UsageError(f"cannot read {item!r}", expected="ITEM=VALUE, such as holding:100=42")
        tags = tags_of([name], target.protocol, raw.form, target.profile, target.dictionary)
        if len(tags) != 1:
            raise UsageError(f"{name!r} means {len(tags)} values", expected="one tag, or a separate value for each")
        pairs.append((with_care(tags[0], target.profile), value))
    return pairs


async def _write(
    target: DeviceTarget, writes: Sequence[Write], log: Path | None, *, yes: bool, hold_s: float | None, blind: bool
) -> list[Written]:
    with logged(log) as taps:
        async with point_at(target, taps=taps) as point:
            old = [None if blind else await writing.before(point, w) for w in writes]
            if hold_s is not None and None in old:
                raise NotAllowed("a value that cannot be read cannot be restored", expected="no --restore")
            _show(writes, old)
            if not yes and not click.confirm("Write?", default=False, err=True):
                raise click.Abort
            return await _carry_out(point, writes, old, hold_s)


async def _carry_out(
    point: Point, writes: Sequence[Write], old: Sequence[PointValue | None], hold_s: float | None
) -> list[Written]:
    """Write all values in order. With `hold_s`, restore them afterwards, also after a failure or an interruption."""
    done: list[Written] = []
    try:
        for write, before in zip(writes, old, strict=True):
            # counts as written until the outcome is known
            done.append(Written(write, before.value.raw if before is not None else None, None))
            done[-1] = await writing.carry_out(point, write, before)
        if hold_s is not None:
            stderr.print(f"written; the old values are restored in {hold_s:g} s")
            await asyncio.sleep(hold_s)
    except BaseException:
        told = done[:-1] if hold_s is None else await _put_back(point, done)
        for written in told:
            stderr.print(Text("" if hold_s is not None else "before that: ") + _told(written), soft_wrap=True)
        raise
    return done if hold_s is None else await _put_back(point, done)


async def _put_back(point: Point, done: list[Written]) -> list[Written]:
    """Restore the old values in reverse order; a failure does not stop the rest, and the first one is raised at the end."""
    back: list[Written] = []
    failed: FieldtwinError | None = None
    for written in reversed(done):
        try:
            back.insert(0, await writing.restore(point, written))
        except FieldtwinError as e:
            stderr.print(Text(f"{written.write.tag.name} was not restored: {e}", "red"), soft_wrap=True)
            failed = failed or e
    if failed is not None:
        raise failed
    return back


def _show(writes: Sequence[Write], old: Sequence[PointValue | None]) -> None:
    for write, before in zip(writes, old, strict=True):
        was = text_of(write.tag, before) if before is not None else "(not read)"
        line = Text.assemble((write.tag.name, "bold"), f": {was} → {_new(write)} {write.tag.unit}".rstrip())
        stderr.print(line, soft_wrap=True)
        for warning in write.warnings:
            stderr.print(Text(f"  {warning}", "yellow"), soft_wrap=True)


def _new(write: Write) -> str:
    return text_of(write.tag, PointValue(decoded(write.tag, write.data, 1)))


def _held(tag: Tag, raw: bytes | None) -> str:
    return "(not read)" if raw is None else text_of(tag, PointValue(decoded(tag, raw, 1)))


def _told(written: Written) -> Text:
    tag = written.write.tag
    if written.restored:
        return Text(f"{tag.name}: {_held(tag, written.after)} again")
    if written.same:
        return Text(f"{tag.name}: {_held(tag, written.after)} already, nothing was written")
    if written.after is None:
        return Text(f"{tag.name}: written, but it cannot be read back")
    return Text(f"{tag.name}: {_held(tag, written.before)} → {_held(tag, written.after)}, read back")


def _row(written: Written) -> dict[str, Any]:
    tag, secret = written.write.tag, written.write.tag.secret
    return {
        "name": tag.name,
        "before": None if written.before is None or secret else written.before.hex(),
        "after": None if written.after is None or secret else written.after.hex(),
        "verified": written.after is not None,
        "written": not written.same,
        "restored": written.restored,
    }


def _restart(
    target: DeviceTarget, items: Sequence[str], log: Path | None, *, i_know: bool, yes: bool, dry_run: bool
) -> int:
    """Send function 08h, sub-function 01h: the unit restarts its port and clears its counters (AP 6.8.1)."""
    if items or target.protocol != "modbus":
        raise UsageError("--restart-communications takes no ITEM and needs a Modbus unit")
    request = Diagnostics(RESTART_COMMUNICATIONS)
    if dry_run:
        click.echo(frame_of(target.url, target.address, request).hex(" "))
        return 0
    if not i_know:
        raise NotAllowed("a restart clears counters and may interrupt the connection", expected="--i-know")
    if not yes and not (sys.stdin.isatty() and click.confirm("Restart its communications?", default=False, err=True)):
        raise NotAllowed("not restarted", expected="--yes")

    async def send() -> bool:
        with logged(log) as taps:
            async with modbus_at(target.url, timeout_s=target.timeout_s, echo=target.echo, taps=taps) as client:
                try:
                    await client.execute(target.address, request)
                except ReplyTimeout:
                    return False  # a unit in listen-only mode restarts without a reply (AP 6.8.1)
                return True

    answered = run_precise(send())
    stdout.print("restarted" if answered else "sent; there was no reply, as is normal for a unit in listen-only mode")
    return 0
