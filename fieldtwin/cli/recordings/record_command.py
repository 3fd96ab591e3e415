"""`fieldtwin record`: record a device's replies, the traffic of a serial line, or a CAN bus."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable, Coroutine, Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
from rich.status import Status

from fieldtwin.capture.recordings.importing import TextSummary, import_capture
from fieldtwin.capture.recordings.rotating_file import MB, RotatingFile, exchanges_of, header_of
from fieldtwin.capture.recordings.sinks import CanLogSink, ExchangeSink, LineSink
from fieldtwin.cli.device.device_options import DeviceOptions, log_option, logged, words
from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import json_option
from fieldtwin.cli.recordings.nothing_recorded import (
    NOTHING_RECORDED,
    OF_BUS,
    OF_POLLING,
    OF_SNIFFER,
    OF_TAP,
    nothing_recorded,
)
from fieldtwin.cli.recordings.record_options import FileOptions, PollOptions, RecordingSourceOptions
from fieldtwin.commissioning.access.address import tags_of
from fieldtwin.commissioning.access.reading import DeviceTarget, dry_point
from fieldtwin.commissioning.record.asking import frame_for
from fieldtwin.commissioning.record.polling import (
    PollCounters,
    ProfileRound,
    Round,
    SameRequests,
    follow_bus,
    record_node,
    record_polls,
)
from fieldtwin.commissioning.record.sniffing import LineSniffer
from fieldtwin.commissioning.record.tapping import LineTap
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.concurrency.stop_signal import stop_signal
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.recording import RecordingHeader, encode_header
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.gateway.wallclock import run as run_precise

REFRESH_S = 0.5


@click.command("record", cls=GroupedCommand)
@click.argument("endpoint", required=False)
@group("Source", source=RecordingSourceOptions)
@group("Polling", polling=PollOptions)
@group("Device", device=DeviceOptions)
@group("Output", files=FileOptions)
@group("Output", log_option, json_option)
def command(
    endpoint: str | None,
    source: RecordingSourceOptions,
    polling: PollOptions,
    device: DeviceOptions,
    files: FileOptions,
    log: Path | None,
    as_json: bool,
) -> int:
    """Record a device at ENDPOINT by polling it (nothing is written), a line between two ports, or a CAN bus.

    \b
    fieldtwin record rtu:/dev/ttyUSB0 --profile eastron-sdm630 -o meter.jsonl
    fieldtwin record tcp://192.168.0.7 --like old.jsonl --rounds 20 -o new.jsonl
    fieldtwin record --tap rtu:/dev/ttyUSB0 rtu:/dev/ttyUSB1 -o line.jsonl
    fieldtwin record --sniff 'rtu:/dev/ttyUSB0?baudrate=9600' -o line.jsonl
    fieldtwin record --tap tcp://127.0.0.1:1502 tcp://192.168.0.7 -o line.jsonl
    fieldtwin record can:socketcan/can0 -o bus.log            (listens only)
    fieldtwin record can:socketcan/can0 --profile drive-cia402 -o drive.log
    fieldtwin record run.jsonl --as-scenario observatory -o run.scenario.yaml

    Replay the recording with `fieldtwin emulate`, or compare a device with it: `fieldtwin compare`. Exit code 1: nothing was
    recorded; 4: the device does not answer.
    """
    like = source.like
    if source.as_scenario:
        return _scenario_of(endpoint, source.as_scenario, files.out, device.profiles)
    job = _Job(files, polling, log, as_json)
    if source.taps is not None:
        if endpoint or like or device.profile_name:
            raise UsageError("--tap takes two endpoints and no device to poll")
        return job.tap(*(_end(text) for text in source.taps))
    if source.sniff is not None:
        if endpoint or like or device.profile_name:
            raise UsageError("--sniff takes one port and no device to poll")
        return job.sniff(_end(source.sniff))
    if endpoint is None:
        raise UsageError("the source of the recording is missing", expected="ENDPOINT, --tap A B, or --sniff PORT")
    target = device.target(endpoint)
    if target.protocol == "canopen":
        if like is not None:
            raise UsageError("--like is for Modbus")
        return job.bus(target, device.node)
    if like is not None:
        same = SameRequests(exchanges_of(like), device.unit)
        if not same.requests:
            raise UsageError(f"{like.name} has no requests that may be repeated", hint="only reads may be repeated")
        if same.left_out:
            stderr.print(
                f"{same.left_out} requests of {like.name} that may change the device are left out", soft_wrap=True
            )
        return job.polls(target, same, header_of(like).device)
    if target.profile is None:
        raise UsageError(
            "the requests are not defined",
            expected="--profile NAME or --like RECORDING",
            hint="or --tap A B to record without polling",
        )
    if target.profile.form.trigger is not None:
        stderr.print(
            f"{target.profile.name} measures only on command, and no command is sent: nothing is written",
            soft_wrap=True,
        )
    return job.polls(target, ProfileRound(target.profile, target.address, polling.groups), target.profile.name)


def _scenario_of(run: str | None, system: str, out: Path, profiles: tuple[Path, ...]) -> int:
    """Write a recorded run as a scenario, with the default tolerances of `fieldtwin trace --as-scenario`."""
    from fieldtwin.cli.recordings.regression_view import write_scenario
    from fieldtwin.scenarios.regression.comparing import Allowed
    from fieldtwin.twin.site.system import load_system

    if run is None:
        raise UsageError("which run?", expected="the file of simulate --trace, or of run --capture")
    plant = load_system(system, profiles)
    return write_scenario(plant, Path(run), out, system, allowed=Allowed(), seed=None, values=False)


def _end(text: str) -> Endpoint:
    """Return the endpoint of one side of a relay (`--tap`); a plain path is a serial port."""
    return Endpoint.parse(text if ":" in text else f"rtu:{text}")


class _Job:
    """One recording: its file, its end condition, and its output on the terminal."""

    def __init__(self, files: FileOptions, polling: PollOptions, log: Path | None, as_json: bool) -> None:
        self._out, self._emulated, self._polling, self._log, self._json = (
            files.out,
            files.emulated,
            polling,
            log,
            as_json,
        )
        self._clock = WallClock()
        self._seconds, self._note = 0.0, ""
        self._parts: dict[str, Any] = {
            "max_bytes": files.part_mb * MB, "max_s": files.part_s or 0.0, "keep": files.keep or 0
        }  # fmt: skip

    # -- kinds --------------------------------------------------------------------------------------------------------

    def polls(self, target: DeviceTarget, one_round: Round, device: str) -> int:
        if self._polling.dry_run:
            return self._dry(frame_for(target.url, unit, pdu) for unit, pdu in one_round.asks)
        counters = PollCounters()
        header = RecordingHeader(
            version=1, device=device, kind="exchanges", source="measured", endpoint=target.url, made_by=words(),
            profile_hash=target.profile.hash if target.profile else "", start_utc=self._now(),
            prototype=self._emulated,
        )  # fmt: skip
        with logged(self._log) as taps, RotatingFile(self._out, encode_header(header), **self._parts) as file:

            async def work(stop: asyncio.Event) -> None:
                await record_polls(
                    target, one_round, ExchangeSink(file), every_s=self._polling.every_s, counters=counters, stop=stop,
                    rounds=self._polling.rounds or 0, spacing_s=self._polling.spacing_s, taps=taps, clock=self._clock,
                )  # fmt: skip

            self._run(work, lambda: f"{counters.rounds} rounds, {counters.exchanges} exchanges")
        self._missing(file, "no request was sent", target.url, OF_POLLING)
        return self._summary(file, counters, {"exchanges": file.lines})

    def _dry(self, frames: Iterable[bytes | str | None]) -> int:
        for frame in frames:
            if frame is not None:
                click.echo(frame if isinstance(frame, str) else frame.hex(" "))
        return 0

    def bus(self, target: DeviceTarget, node: int | None) -> int:
        polled = target.profile is not None or target.dictionary is not None
        if not polled and node is not None:
            raise UsageError(
                "nothing to read from the node",
                expected="--profile NAME or --eds FILE",
                hint="without --node: only listen",
            )
        if self._polling.dry_run:
            tags = tags_of((), "canopen", None, target.profile, target.dictionary) if polled else []
            return self._dry(dry_point(target).read_frames(tags))
        counters, lost = PollCounters(), 0
        if self._log:
            raise UsageError("--log: a recording of a CAN bus already contains all its frames")
        with RotatingFile(self._out, **self._parts) as file:
            sink = CanLogSink(file, self._clock, Endpoint.parse(target.url).path.rpartition("/")[2].replace(":", "_"))

            async def work(stop: asyncio.Event) -> None:
                nonlocal lost
                if not polled:
                    lost = await follow_bus(target, sink, stop=stop, clock=self._clock)
                    return
                await record_node(
                    target, sink, every_s=self._polling.every_s, counters=counters, stop=stop,
                    rounds=self._polling.rounds or 0, clock=self._clock,
                )  # fmt: skip

            self._run(work, lambda: f"{file.lines} frames")
        self._missing(file, "no frame arrived", target.url, OF_BUS)
        return self._summary(file, counters if polled else None, {"frames": file.lines, "lost_here": lost})

    def tap(self, near: Endpoint, far: Endpoint) -> int:
        """Record a serial line that this process relays between two ports."""

        def tapped(sink: LineSink) -> Callable[[asyncio.Event], Coroutine[Any, Any, None]]:
            return LineTap(near, far, sink, on_message=self._print_message, clock=self._clock).run

        return self._line(far, tapped, "tapped", OF_TAP, "bytes to the device", "back")

    def sniff(self, port: Endpoint) -> int:
        """Record a serial line between other devices, to which one adapter listens."""
        return self._line(
            port,
            lambda sink: LineSniffer(port, sink, on_message=self._print_message, clock=self._clock).run,
            "sniffed",
            OF_SNIFFER,
            "bytes of requests",
            "of replies",
        )

    @staticmethod
    def _print_message(text: str) -> None:
        stderr.print(text, soft_wrap=True, markup=False)

    def _line(
        self,
        far: Endpoint,
        listening: Callable[[LineSink], Callable[[asyncio.Event], Coroutine[Any, Any, None]]],
        how: str,
        check: str,
        there: str,
        back: str,
    ) -> int:
        """Write the bytes to a file as they arrive, then convert them to a recording of exchanges. Return the exit code.

        `listening` returns the function that receives the bytes. `how` (``tapped``, ``sniffed``) becomes part of the
        device's name, `check` is the advice if nothing arrived, `there` and `back` name the two directions in the status
        line.
        """
        if self._out.exists():
            raise UsageError(f"{self._out} exists already", expected="another name")
        started = self._now()
        raw = self._out.with_suffix(f".tap{self._out.suffix or '.jsonl'}")
        with RotatingFile(raw, **self._parts) as file:
            sink = LineSink(file, far, self._clock, words())
            self._run(
                listening(sink),
                lambda: f"{sink.bytes[Direction.SENT]} {there}, {sink.bytes[Direction.RECEIVED]} {back}",
            )
        said: dict[str, Any] = {
            "bytes_sent": sink.bytes[Direction.SENT], "bytes_received": sink.bytes[Direction.RECEIVED]
        }  # fmt: skip
        passed = sum(sink.bytes.values())
        if not passed:
            self._missing(file, "no byte passed", str(far), check)
            return self._summary(file, None, said)
        said["raw"] = str(raw)
        header = RecordingHeader(
            version=1, device=f"{how}/{self._out.stem}", kind="exchanges", source="measured", endpoint=str(far),
            made_by=words(), start_utc=started, prototype=self._emulated,
        )  # fmt: skip
        found: TextSummary = import_capture(raw, self._out, url=str(far), header=header)
        said |= {
            "exchanges": found.records, "unanswered": found.pairs.unanswered, "strays": found.pairs.strays,
            "malformed": found.pairs.malformed, "recording": str(self._out), "profiles": list(map(str, found.profiles)),
        }  # fmt: skip
        if not found.records:
            self._note = nothing_recorded(f"{passed} bytes passed, but no request,", str(far), self._seconds, check)
            self._out.unlink()
        return self._summary(file, None, said)

    # -- running and reporting ---------------------------------------------------------------------------------------------

    def _now(self) -> str:
        return datetime.fromtimestamp(self._clock.utc_ns() / NS_PER_S, UTC).isoformat(timespec="milliseconds")

    def _missing(self, file: RotatingFile, what: str, where: str, check: str) -> None:
        """If `file` is empty, keep the message that nothing was recorded, and remove the file: its name is free for the
        next attempt.
        """
        if not file.lines:
            self._note = nothing_recorded(what, where, self._seconds, check)
            file.path.unlink()

    def _run(self, work: Callable[[asyncio.Event], Coroutine[Any, Any, None]], status: Callable[[], str]) -> None:
        """Run `work` until the recording ends, a signal arrives, or the time of --for has passed; `status` gives the status
        line.
        """

        for_s = self._polling.for_s

        async def main() -> None:
            stop = stop_signal()
            timer = asyncio.get_running_loop().call_later(for_s, stop.set) if for_s is not None else None
            showing = asyncio.ensure_future(_shown(shown, status)) if shown is not None else None
            try:
                await work(stop)
            finally:
                if timer is not None:
                    timer.cancel()
                if showing is not None:
                    showing.cancel()
                    await asyncio.gather(showing, return_exceptions=True)

        with _status() as shown:
            began_ns = self._clock.monotonic_ns()
            run_precise(main())
            self._seconds = (self._clock.monotonic_ns() - began_ns) / NS_PER_S

    def _summary(self, file: RotatingFile, counters: PollCounters | None, said: dict[str, Any]) -> int:
        """Print the result. Return 0, 1 if nothing was recorded, or 4 if no device ever answered."""
        polled = counters is not None and counters.exchanges > 0
        silent = counters is not None and polled and counters.unanswered == counters.exchanges
        code = NOTHING_RECORDED if self._note else 4 if silent else 0
        if self._json:
            parts: dict[str, Any] = {
                "out": str(self._out),
                "parts": [str(part) for part in file.parts if part.exists()],
                "removed": file.removed,
                "seconds": round(self._seconds, 3),
                "notes": [self._note] if self._note else [],
            }
            if counters is not None:
                parts |= {
                    "rounds": counters.rounds, "missed_rounds": counters.missed, "unanswered": counters.unanswered,
                    "refused": counters.refused, "connections_lost": counters.lost,
                }  # fmt: skip
            json.dump(parts | said, sys.stdout)
            sys.stdout.write("\n")
            return code
        names = {"bytes_sent": "bytes to the device", "bytes_received": "bytes back", "lost_here": "frames lost here"}
        text = ", ".join(
            f"{v} {names.get(k, k)}"
            for k, v in said.items()
            if isinstance(v, int) and (v or k in ("exchanges", "frames"))
        )
        if self._note:
            stderr.print(self._note, soft_wrap=True, markup=False)
        else:
            stdout.print(f"{said.get('recording', self._out)}: {text}", soft_wrap=True, markup=False)
        for profile in said.get("profiles", ()):
            stdout.print(f"  draft profile: {profile}", soft_wrap=True, markup=False)
        if "raw" in said:
            stdout.print(f"  the unchanged bytes: {said['raw']}", soft_wrap=True, markup=False)
        if len(file.parts) > 1:
            gone = f", {file.removed} older ones removed" if file.removed else ""
            stderr.print(f"in {len(file.parts)} parts{gone}", soft_wrap=True)
        if counters is not None:
            notes = [
                (counters.rounds, "rounds"), (counters.missed, "rounds that could not begin in time"),
                (counters.unanswered, "without an answer"), (counters.refused, "refused"),
                (counters.lost, "times the connection was lost"),
            ]  # fmt: skip
            stderr.print(", ".join(f"{n} {what}" for n, what in notes if n), soft_wrap=True)
        return code


@contextmanager
def _status() -> Iterator[Status | None]:
    """Yield a status line on a terminal, None elsewhere."""
    if not stderr.is_terminal:
        yield None
        return
    with stderr.status("recording") as status:
        yield status


async def _shown(status: Status, text: Callable[[], str]) -> None:
    while True:
        status.update(f"recording: {text()}  (Ctrl-C ends it)")
        await asyncio.sleep(REFRESH_S)
