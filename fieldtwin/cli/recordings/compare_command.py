"""`fieldtwin compare`: compare a device with a recording."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable, Coroutine
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from fieldtwin.capture.recordings.comparing import Comparer, Comparison, Rules, pairs_of, request_of
from fieldtwin.capture.recordings.comparing_can import Frames, compare_logs
from fieldtwin.capture.recordings.rotating_file import exchanges_of, header_of, parts_of
from fieldtwin.cli.device.device_options import DeviceOptions, log_option, logged
from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import json_option
from fieldtwin.cli.recordings.compare_options import LiveOptions, RuleOptions
from fieldtwin.cli.recordings.compare_view import SHOWN, advise_profile, print_comparison
from fieldtwin.commissioning.record.asking import asker_at, changes, frame_for
from fieldtwin.commissioning.record.comparing import compare_device, compare_node, uploads_of
from fieldtwin.console import stderr
from fieldtwin.gateway.core.concurrency.stop_signal import stop_signal
from fieldtwin.gateway.core.endpoint import SCHEMES
from fieldtwin.gateway.core.errors import FileInvalid, NotAllowed, UsageError
from fieldtwin.gateway.core.files.candump import read_log
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.protocols.canopen.sdo.transfers import SdoUpload
from fieldtwin.gateway.wallclock import run as run_precise
from fieldtwin.reports.site.about import headed
from fieldtwin.twin.site.data_files import find

INCONCLUSIVE = 4
"""Exit code: all compared values agree, but some could not be compared."""


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
        print_comparison(result, recording, other, everything)
        if recording.suffix != ".log" and not device.profile_name:
            advise_profile(result, header_of(recording).device)
    return 0 if result.met else INCONCLUSIVE if result.inconclusive else 1


def _headed(recording: Path, other: str, live: bool, device: DeviceOptions) -> dict[str, Any]:
    """Return the header of the JSON result, which names the device and the recording: `fieldtwin report` reads it."""
    can = recording.suffix == ".log"
    address = device.node if can else device.unit
    if address is None and not can:
        address = next((exchange.unit for exchange in exchanges_of(recording)), 0)
    endpoint, name = (other, "") if live else ("", Path(other).name)
    return headed("compare", "canopen" if can else "modbus", endpoint, address or 0, recording.name, device=name)


def _dry(recording: Path, url: str, device: DeviceOptions, sending: LiveOptions) -> int:
    """Print the frames that would be sent, with their repetitions. Return the exit code."""
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
                    wearing=_limited_write_cycles(target.profile),
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
    """Show the recorded writes and ask for confirmation before they are sent to a device. Raises `NotAllowed` without it."""
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


def _limited_write_cycles(profile: DeviceProfile | None) -> set[tuple[str, int]]:
    """Return (table, address) of the cells with a limited number of write cycles. Each is written once, and never repeatedly."""
    tags = profile.tags.values() if profile is not None else ()
    return {(t.at.table, a) for t in tags if t.nonvolatile and t.at for a in range(t.at.address, t.at.end)}


def _run(work: Callable[[asyncio.Event, Callable[[int], None]], Coroutine[Any, Any, None]]) -> None:
    """Run `work` until the comparison is done or a signal ends it. The result then covers the exchanges compared so far."""

    async def main() -> None:
        stop = stop_signal()
        if not stderr.is_terminal:
            await work(stop, lambda done: None)
            return
        with stderr.status("comparing") as status:
            await work(stop, lambda done: status.update(f"comparing: {done} exchanges"))

    run_precise(main())
