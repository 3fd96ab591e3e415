"""`fieldtwin compare`: compare a device with a recording."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable, Coroutine
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click
from rich.table import Table

from fieldtwin.capture.recordings.comparing import Comparer, Comparison, Rules, Tolerance, pairs_of, request_of
from fieldtwin.capture.recordings.comparing_can import Frames, compare_logs
from fieldtwin.capture.recordings.rotating_file import exchanges_of, header_of, parts_of
from fieldtwin.cli.device.device_options import DeviceOptions, log_option, logged
from fieldtwin.cli.option_groups import GroupedCommand, group, option
from fieldtwin.cli.options import Duration, json_option, pairs
from fieldtwin.commissioning.record.asking import asker_at, changes, frame_for
from fieldtwin.commissioning.record.comparing import compare_device, compare_node, uploads_of
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.concurrency.stop_signal import stop_signal
from fieldtwin.gateway.core.endpoint import SCHEMES
from fieldtwin.gateway.core.errors import FileInvalid, NotAllowed, UsageError
from fieldtwin.gateway.core.files.candump import read_log
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.recording import shown
from fieldtwin.gateway.protocols.canopen.sdo.transfers import SdoUpload
from fieldtwin.gateway.wallclock import run as run_precise
from fieldtwin.reports.site.about import headed
from fieldtwin.twin.site.data_files import find

SHOWN = 20
INCONCLUSIVE = 4
"""Exit code: all compared values agree, but some could not be compared."""


@dataclass(frozen=True)
class RuleOptions:
    """How much the two may differ, as texts."""

    tolerances: tuple[str, ...] = option(
        "--tolerance",
        multiple=True,
        metavar="[TAG=]AMOUNT",
        help="Tolerance of values, such as 2 or 1% or frequency=0.05; repeatable. Default: 0.",
    )
    latency: str = option(
        "--latency",
        default="20ms/50%",
        show_default=True,
        metavar="AMOUNT",
        help="What median and 90 % of the latencies may differ by, whichever of the two is more; `any`: not judged.",
    )
    least: float = option(
        "--least",
        type=click.FloatRange(0, 100),
        default=100.0,
        show_default=True,
        metavar="PERCENT",
        help="Required share of equal exchanges.",
    )

    @property
    def rules(self) -> Rules:
        """Return the parsed rules. Raises `UsageError`."""
        return Rules(*_tolerances(self.tolerances), _latency(self.latency), self.least / 100)


@dataclass(frozen=True)
class LiveOptions:
    """The requests to a live device, and the confirmation of writes. `most` None: every request of the recording."""

    most: int | None = option(
        "--most", type=click.IntRange(1), default=None, help="With a live device: send only this many requests."
    )
    listen_s: float = option(
        "--listen",
        type=Duration(),
        default="0s",
        help="With a live bus: listen for this time, and compare messages too.",
    )
    spacing_s: float = option(
        "--spacing", type=Duration(), default="0s", help="With a live device: pause after every exchange."
    )
    writes: bool = option(
        "--writes", is_flag=True, help="With a live device: repeat the recorded writes as well, after a confirmation."
    )
    yes: bool = option("--yes", is_flag=True, help="With --writes: do not ask for confirmation.")
    i_know: bool = option(
        "--i-know", is_flag=True, help="With --writes: repeat broadcasts and restarts (FC08) as well."
    )
    dry_run: bool = option(
        "--dry-run", is_flag=True, help="With a live device: print the frames that would be sent; send nothing."
    )


@click.command("compare", cls=GroupedCommand)
@click.argument("recording", type=click.Path(dir_okay=False, path_type=Path))
@click.argument("other")
@group("Comparison", allowed=RuleOptions)
@group("Live device", sending=LiveOptions)
@group("Device", device=DeviceOptions)
@group(
    "Output",
    click.option("--all", "everything", is_flag=True, help=f"Show all differences, not only the first {SHOWN}."),
    log_option,
    json_option,
)
def command(
    recording: Path,
    other: str,
    allowed: RuleOptions,
    sending: LiveOptions,
    device: DeviceOptions,
    everything: bool,
    log: Path | None,
    as_json: bool,
) -> int:
    """Compare OTHER, a device at an endpoint or another recording, with RECORDING: the same requests, and their answers.

    \b
    fieldtwin compare meter.jsonl rtu:/dev/ttyUSB0 \\
        --profile eastron-sdm630 --tolerance 2%
    fieldtwin compare meter.jsonl emulated.jsonl
    fieldtwin compare drive.log can:socketcan/can0 --node 5 --listen 10s

    It prints the fidelity: the share of equal exchanges (values), and the agreement of the latencies (timing). Exit code 1 if
    the fidelity is too low, 4 if too much could not be compared. A device is only read, except with --writes.
    """
    rules = allowed.rules
    live = other.partition(":")[0].lower() in SCHEMES and not Path(other).is_file()
    if not live and (sending.writes or sending.dry_run):
        raise UsageError("--writes and --dry-run need a live device")
    if sending.dry_run:
        return _dry(recording, other, device, sending)
    if recording.suffix == ".log":
        result = (
            _live_can(recording, other, rules, device, sending, log)
            if live
            else _logs(recording, Path(other), rules, device)
        )
    elif live:
        result = _live(recording, other, rules, device, sending, log)
    else:
        result = _files(recording, Path(other), rules, device)
    if as_json:
        json.dump(
            _headed(recording, other, live, device)
            | asdict(result)
            | {
                "values": result.values if result.compared else None,
                "met": result.met,
                "inconclusive": result.inconclusive,
            },
            sys.stdout,
        )
        sys.stdout.write("\n")
    else:
        _show(result, recording, other, everything)
    return 0 if result.met else INCONCLUSIVE if result.inconclusive else 1


def _headed(recording: Path, other: str, live: bool, device: DeviceOptions) -> dict[str, Any]:
    """Add the header that names the device and the reference: `fieldtwin report` reads it."""
    can = recording.suffix == ".log"
    address = device.node if can else device.unit
    if address is None and not can:
        address = next((exchange.unit for exchange in exchanges_of(recording)), 0)
    endpoint, name = (other, "") if live else ("", Path(other).name)
    return headed("compare", "canopen" if can else "modbus", endpoint, address or 0, recording.name, device=name)


def _dry(recording: Path, url: str, device: DeviceOptions, sending: LiveOptions) -> int:
    """Print the frames that would be sent, with their repetitions."""
    target = device.target(url)
    asked = 0
    if recording.suffix == ".log":
        for exchange in uploads_of(_frames(recording), device.node):
            if not sending.most or asked < sending.most:
                asked += 1
                span = exchange.spans[0]
                click.echo(str(SdoUpload(exchange.unit, span.address, span.subindex, 0).start(0)))
        return 0
    for e in exchanges_of(recording):
        if (changes(e.request) and not sending.writes) or (sending.most and asked >= sending.most):
            continue
        frame = frame_for(target.url, e.unit if device.unit is None else device.unit, e.request)
        if frame is not None:
            asked += 1
            click.echo(frame.hex(" "))
    return 0


# -- tolerances -----------------------------------------------------------------------------------------------------------


def _tolerances(texts: tuple[str, ...]) -> tuple[Tolerance, dict[str, Tolerance]]:
    plain = [t for t in texts if "=" not in t]
    named = pairs(tuple(t for t in texts if "=" in t), "--tolerance")
    if len(plain) > 1:
        raise UsageError("one tolerance for all, others by tag", got=", ".join(plain))
    return (_tolerance(plain[0]) if plain else Tolerance()), {tag: _tolerance(text) for tag, text in named.items()}


def _tolerance(text: str) -> Tolerance:
    try:
        if text.endswith("%"):
            return Tolerance(share=_positive(text[:-1]) / 100)
        return Tolerance(_positive(text))
    except ValueError:
        raise UsageError("cannot read a tolerance", expected="a number such as 2, or 1%", got=text) from None


def _positive(text: str) -> float:
    value = float(text)
    if not 0 <= value < 1e300:
        raise ValueError
    return value


def _latency(text: str) -> Tolerance | None:
    if text == "any":
        return None
    absolute = share = 0.0
    for part in text.split("/"):
        if part.endswith("%"):
            share = _tolerance(part).share
        else:
            absolute = float(Duration().convert(part, None, None))
    return Tolerance(absolute, share)


# -- the four cases -----------------------------------------------------------------------------------------------------


def _profile(device: DeviceOptions) -> DeviceProfile | None:
    return load_profile(find("devices", device.profile_name, extra=device.profiles)) if device.profile_name else None


def _files(recording: Path, other: Path, rules: Rules, device: DeviceOptions) -> Comparison:
    for path in (recording, other):
        _expect_exchanges(path)
    comparer, unit = Comparer(rules, _profile(device)), device.unit
    mine, theirs = ((e for e in exchanges_of(p) if unit in (None, e.unit)) for p in (recording, other))
    for one, two in pairs_of(mine, theirs, request_of):
        comparer.add(one, two)
    return comparer.result()


def _live(
    recording: Path, url: str, rules: Rules, device: DeviceOptions, sending: LiveOptions, log: Path | None
) -> Comparison:
    _expect_exchanges(recording)
    target = device.target(url)
    if target.protocol != "modbus":
        raise UsageError(f"{recording.name} is of a Modbus device", got=url)
    if sending.writes:
        _allow_writes(recording, url, sending)
    comparer = Comparer(rules, target.profile)

    async def work(stop: asyncio.Event, progress: Callable[[int], None]) -> None:
        with logged(log) as taps:
            async with asker_at(
                target.url,
                timeout_s=target.timeout_s,
                spacing_s=sending.spacing_s,
                echo=target.echo,
                taps=tuple(taps),
            ) as asker:
                await compare_device(
                    exchanges_of(recording), asker, comparer, unit=device.unit, writes=sending.writes,
                    wearing=_wearing(target.profile),
                    most=sending.most or 0, stop=stop, progress=progress,
                )  # fmt: skip

    _run(work)
    return comparer.result()


def _logs(recording: Path, other: Path, rules: Rules, device: DeviceOptions) -> Comparison:
    nodes = () if device.node is None else (device.node,)
    return compare_logs(_frames(recording), _frames(other), rules, profile=_profile(device), nodes=nodes)


def _live_can(
    recording: Path, url: str, rules: Rules, device: DeviceOptions, sending: LiveOptions, log: Path | None
) -> Comparison:
    target = device.target(url)
    if target.protocol != "canopen":
        raise UsageError(f"{recording.name} is of a CAN bus", got=url)
    if sending.writes:
        raise UsageError("--writes needs a Modbus device")
    found: list[Comparison] = []

    async def work(stop: asyncio.Event, progress: Callable[[int], None]) -> None:
        with logged(log) as taps:
            result = await compare_node(
                lambda: _frames(recording), target, rules, node=device.node, most=sending.most or 0,
                listen_s=sending.listen_s, taps=taps, stop=stop, progress=progress,
            )  # fmt: skip
        found.append(result)

    _run(work)
    return found[0]


def _frames(path: Path) -> Frames:
    for part in parts_of(path):
        yield from ((t_ns, frame) for t_ns, _, frame in read_log(part))


def _expect_exchanges(path: Path) -> None:
    if header_of(path).kind != "exchanges":
        raise FileInvalid("a recording of signals contains no requests", path=str(path), expected="one of exchanges")


def _allow_writes(recording: Path, url: str, sending: LiveOptions) -> None:
    """Ask once before writing to a plant, and show what would be written."""
    writes = [e for e in exchanges_of(recording) if changes(e.request)]
    dangerous = [e for e in writes if e.unit == 0 or e.request[0] == 8]
    if dangerous and not sending.i_know:
        raise NotAllowed(f"{len(dangerous)} of the recorded writes are broadcasts or diagnostics", hint="--i-know")
    if not writes or sending.yes:
        return
    for exchange in writes[:SHOWN]:
        stderr.print(f"  unit {exchange.unit}: {exchange.request.hex(' ')}", soft_wrap=True, markup=False)
    if not sys.stdin.isatty() or not click.confirm(f"make these {len(writes)} writes at {url}?", err=True):
        raise NotAllowed("the writes were not confirmed", hint="--yes")


def _wearing(profile: DeviceProfile | None) -> set[tuple[str, int]]:
    """Return the items with a limited number of write cycles. Each is written once, and never repeatedly."""
    tags = profile.tags.values() if profile is not None else ()
    return {(t.at.table, a) for t in tags if t.nonvolatile and t.at for a in range(t.at.address, t.at.end)}


def _run(work: Callable[[asyncio.Event, Callable[[int], None]], Coroutine[Any, Any, None]]) -> None:
    """Run until the comparison is done or a signal ends it. The result then covers the exchanges that were compared so far."""

    async def main() -> None:
        stop = stop_signal()
        if not stderr.is_terminal:
            await work(stop, lambda done: None)
            return
        with stderr.status("comparing") as status:
            await work(stop, lambda done: status.update(f"comparing: {done} exchanges"))

    run_precise(main())


# -- output --------------------------------------------------------------------------------------------------------------


def _show(result: Comparison, recording: Path, other: str, everything: bool) -> None:
    name = recording.name if recording.suffix == ".log" else shown(parts_of(recording)[0])
    stdout.print(f"{other} against {name}", soft_wrap=True, markup=False)
    if result.differences:
        table = Table("at s", "unit", "what", "asked", "where", "recorded", "there", box=None, pad_edge=False)
        for d in result.differences if everything else result.differences[:SHOWN]:
            table.add_row(f"{d.t_s:.3f}", str(d.unit), d.what, d.request, d.where, d.recorded, d.other)
        stdout.print(table)
        left = sum(result.by_kind.values()) - min(len(result.differences), SHOWN)
        if left > 0 and not everything:
            stderr.print("  and more: --all", soft_wrap=True)
    if result.latency:
        table = Table(
            "latency, ms", "n", "recorded p50", "p90", "p99", "there p50", "p90", "p99", box=None, pad_edge=False
        )
        for row in result.latency:
            times = [f"{1000 * t:.1f}" for t in (*row.recorded_s, *row.other_s)]
            table.add_row(row.service, str(row.count), *times, "" if row.alike else "beyond tolerance")
        stdout.print(table)
    kinds = ", ".join(f"{n} {kind}" for kind, n in sorted(result.by_kind.items()))
    stdout.print(
        f"{result.compared} compared, {result.alike} alike" + (f"; otherwise: {kinds}" if kinds else ""), soft_wrap=True
    )
    if result.extra:
        stdout.print(f"{result.extra} more in the other one, which the recording does not contain", soft_wrap=True)
    if result.left_out:
        stdout.print(f"{result.left_out} left out: they may change the device, or cannot be asked", soft_wrap=True)
    if result.left_out_writes and result.by_kind:
        stdout.print(
            f"{result.after_left_out} of the differences are in what {result.left_out_writes} left-out writes had set; "
            "others may follow from these writes: --writes makes them again", soft_wrap=True,
        )  # fmt: skip
    _show_shifts(result)
    timing = "not known" if result.timing is None else f"{100 * result.timing:.1f} %"
    verdict = "met" if result.met else "INCONCLUSIVE" if result.inconclusive else "NOT met"
    alike = f"{100 * result.values:.1f} %" if result.compared else "not known"
    stdout.print(f"fidelity: values {alike}, timing {timing}: {verdict}", soft_wrap=True)


def _show_shifts(result: Comparison) -> None:
    """Print at which positions the live dialogue continued the recorded one, and which exchanges the recording does not cover."""
    for shift in result.shifts[:SHOWN]:
        stdout.print(
            f"unit {shift.unit}, {shift.where}: was read before, continues at value {shift.at + 1} of {shift.recorded} recorded",
            soft_wrap=True, markup=False,
        )  # fmt: skip
    if len(result.shifts) > SHOWN:
        stdout.print(f"and {len(result.shifts) - SHOWN} more registers or bits", soft_wrap=True)
    if result.not_compared:
        stdout.print(
            f"{result.not_compared} not compared: the recording has no values after that position. "
            "Restart the emulator to compare everything", soft_wrap=True,
        )  # fmt: skip
