"""`fieldtwin watch`: show live values of one device."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Sequence
from contextlib import aclosing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
from rich.live import Live
from rich.table import Table
from rich.text import Text

from fieldtwin.cli.device.device_options import DeviceOptions, RawOptions, log_option, logged
from fieldtwin.cli.device.value_table import COLOUR, exit_code
from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import Duration, json_option
from fieldtwin.commissioning.access.address import tags_of
from fieldtwin.commissioning.access.plotting import check_plot, plot
from fieldtwin.commissioning.access.point import PointValue
from fieldtwin.commissioning.access.reading import DeviceTarget, dry_point, point_at, row_of, text_of
from fieldtwin.commissioning.access.watching import History, Sample, samples
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import NotAllowed, Unreachable, UsageError
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.gateway.wallclock import run as run_precise

LEAST_EVERY_S = 0.02


@click.command("watch", cls=GroupedCommand)
@click.argument("endpoint")
@click.argument("items", nargs=-1, metavar="[ITEM]...")
@group("Device", device=DeviceOptions)
@group("Raw addresses", raw=RawOptions)
@group(
    "Samples",
    click.option("--every", "every_s", type=Duration(), default="1s", show_default=True, help="Sample interval."),
    click.option("--samples", "most", type=click.IntRange(1), help="Number of samples; default: until Ctrl-C."),
    click.option("--for", "for_s", type=Duration(), help="Stop after this time."),
)
@group(
    "Output",
    click.option(
        "--plot",
        "plot_path",
        type=click.Path(dir_okay=False, path_type=Path),
        help="Write a plot to this file at the end.",
    ),
    log_option,
    click.option("--dry-run", is_flag=True, help="Print the frames of one sample; send nothing."),
    json_option,
)
def command(
    endpoint: str,
    items: tuple[str, ...],
    device: DeviceOptions,
    raw: RawOptions,
    every_s: float,
    most: int | None,
    for_s: float | None,
    plot_path: Path | None,
    log: Path | None,
    dry_run: bool,
    as_json: bool,
) -> int:
    """Read ITEMs of the device at ENDPOINT periodically, and show a table with sparklines; with --json, one line per sample.

    \b
    fieldtwin watch rtu:/dev/ttyUSB0 --profile eastron-sdm630 \\
        'voltage_*' frequency
    fieldtwin watch tcp://192.168.0.7 holding:100 --type float32 \\
        --every 200ms --for 1m --plot pump.png
    fieldtwin watch can:socketcan/can0 --node 5 --profile drive-cia402 \\
        statusword position --json
    """
    target = device.target(endpoint)
    tags = tags_of(items, target.protocol, raw.form, target.profile, target.dictionary)
    unreadable = [t.name for t in tags if not t.readable]
    if unreadable:
        raise NotAllowed(f"cannot be read: {', '.join(unreadable)}", hint="the profile says `access: wo`")
    if every_s < LEAST_EVERY_S:
        raise UsageError(
            "the interval is too short for a field bus", expected=f"--every {LEAST_EVERY_S * 1000:g}ms at least"
        )
    if dry_run:
        for frame in dry_point(target).read_frames(tags):
            click.echo(frame)
        return 0
    if plot_path is not None:
        check_plot(plot_path)
    watch = _Watch(target, tags, as_json=as_json)
    try:
        run_precise(watch.run(every_s, most, for_s or None, log))
    except KeyboardInterrupt:
        pass  # Ctrl-C is the normal way to stop
    finally:
        watch.close()
    if plot_path is not None and watch.count:
        panels = plot(plot_path, target.url, tags, watch.histories)
        stderr.print(
            f"{panels} curves: {plot_path}" if panels else "no numeric values, so there is no plot", soft_wrap=True
        )
    return watch.exit_code


class _Watch:
    """The samples of a device and their display: one table on a terminal, elsewhere one line per sample."""

    def __init__(self, target: DeviceTarget, tags: Sequence[Tag], *, as_json: bool) -> None:
        self.histories = {t.name: History() for t in tags}
        self.count = 0
        self.exit_code = 0
        self._target, self._tags, self._json = target, tags, as_json
        self._live = Live(console=stdout, auto_refresh=False) if stdout.is_terminal and not as_json else None

    async def run(self, every_s: float, most: int | None, for_s: float | None, log: Path | None) -> None:
        """Take samples for `for_s` seconds, and abandon a sample that is incomplete then.

        Raises `Unreachable` if no sample was complete, as with a silent device: each of its tags takes a whole reply
        timeout.
        """
        try:
            async with asyncio.timeout(for_s) as limit:
                await self._take_all(every_s, most, for_s, log)
        except TimeoutError:
            if not limit.expired():
                raise
            if not self.count:
                hint = "a longer --for, or a shorter --timeout"
                raise Unreachable(
                    f"no sample was complete after {for_s:g} s", where=self._target.url, hint=hint
                ) from None

    async def _take_all(self, every_s: float, most: int | None, for_s: float | None, log: Path | None) -> None:
        with logged(log) as taps:
            async with point_at(self._target, taps=taps) as point:
                if self._live is not None:
                    self._live.start()
                async with aclosing(samples(point, self._tags, WallClock(), every_s, most, for_s)) as stream:
                    async for sample in stream:
                        self._take(sample)
                        await asyncio.sleep(0)

    def close(self) -> None:
        if self._live is not None:
            self._live.stop()

    def _take(self, sample: Sample) -> None:
        self.count = sample.number
        for name, history in self.histories.items():
            history.add(sample.t_s, sample.answers[name])
        self.exit_code = exit_code(sample.answers.values())
        if self._json:
            rows = {t.name: _short(t, sample.answers[t.name]) for t in self._tags}
            at = datetime.fromtimestamp(WallClock().utc_ns() / NS_PER_S, UTC).isoformat(timespec="milliseconds")
            click.echo(json.dumps({"at": at, "t_s": round(sample.t_s, 6), "values": rows}))
        elif self._live is not None:
            self._live.update(self._table(sample), refresh=True)
        else:
            parts = [f"{t.name}={_cell(t, sample.answers[t.name])}" for t in self._tags]
            click.echo(f"{sample.t_s:9.2f}  " + "  ".join(parts))

    def _table(self, sample: Sample) -> Table:
        table = Table(
            box=None, pad_edge=False, header_style="bold", caption=self._caption(sample), caption_justify="left"
        )
        wide = stdout.width
        table.add_column("name", overflow="ellipsis", no_wrap=True)
        table.add_column("value", min_width=12, overflow="ellipsis", no_wrap=True)
        table.add_column("least", justify="right", no_wrap=True)
        table.add_column("most", justify="right", no_wrap=True)
        table.add_column("", no_wrap=True)
        room = max(8, min(60, wide - 62))
        for tag in self._tags[: max(3, stdout.height - 4)]:
            answer, history = sample.answers[tag.name], self.histories[tag.name]
            colour = COLOUR.get(str(answer.value.quality), "")
            low, high = (f"{v:.5g}" if history.samples > history.bad and abs(v) < 1e300 else ""
                         for v in (history.least, history.most))  # fmt: skip
            table.add_row(
                Text(tag.name), Text(_cell(tag, answer), colour), low, high, Text(history.sparkline(room), "cyan")
            )
        return table

    def _caption(self, sample: Sample) -> Text:
        hidden = len(self._tags) - max(3, stdout.height - 4)
        more = f", {hidden} more rows do not fit" if hidden > 0 else ""
        late = f", {sample.late_s:.1f} s late" if sample.late_s > 0.1 else ""
        return Text(f"{self._target.url}: sample {sample.number}, {sample.t_s:.1f} s{late}{more}. Ctrl-C stops", "dim")


def _cell(tag: Tag, answer: PointValue) -> str:
    return answer.problem or f"{text_of(tag, answer)} {tag.unit}".rstrip()


def _short(tag: Tag, answer: PointValue) -> dict[str, Any]:
    row = row_of(tag, answer)
    return {key: row[key] for key in ("value", "quality", "meaning", "reason", "problem") if key in row}
