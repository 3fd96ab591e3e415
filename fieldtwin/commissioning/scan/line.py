"""The command `line`: observe a line before anything is sent, and explain why it is silent or garbled. This module collects
the evidence; `causes` finds the causes.

Nothing is sent, except one request if the user asked for a probe: only a probe can show an echo. A probe is not sent into the
traffic of other devices without permission.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from fieldtwin.commissioning.access.connection import bytes_at
from fieldtwin.commissioning.access.progress import PhaseProgress
from fieldtwin.commissioning.scan import settings as plan
from fieldtwin.commissioning.scan.can_listener import ObservedBus
from fieldtwin.commissioning.scan.canopen import CanScanner, CanScanOptions
from fieldtwin.commissioning.scan.causes import (
    LikelyCause,
    ScanProbe,
    SerialEvidence,
    can_causes,
    serial_causes,
    tcp_causes,
)
from fieldtwin.commissioning.scan.listening import describe
from fieldtwin.commissioning.scan.modbus import ModbusScan, ModbusScanner, ScanOptions
from fieldtwin.commissioning.scan.sweep import SendRequest, UnitSweep
from fieldtwin.commissioning.scan.traffic import Heard
from fieldtwin.gateway.connections.can.facts import CanFacts
from fieldtwin.gateway.connections.serial.line_counters import CountsErrors, UartCounters
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import ByteConnection, Connector, Tap
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.core.errors import ConnectionLost, EndpointBusy, NotAllowed, Unreachable
from fieldtwin.gateway.protocols.modbus.frames.selection import framing_of
from fieldtwin.gateway.wallclock import WallClock

CONNECT_S = 5.0


@dataclass(slots=True)
class LineReport:
    """The observations on a line. `facts` are pairs of a name and a text for the user; the other attributes are for programs."""

    url: str
    kind: str
    facts: list[tuple[str, str]] = field(default_factory=list)
    causes: list[LikelyCause] = field(default_factory=list)
    heard: Heard | None = None
    errors: UartCounters | None = None
    bus: ObservedBus | None = None
    can: CanFacts | None = None
    probe: ScanProbe | None = None
    sent: bool = False

    @property
    def healthy(self) -> bool:
        """Return whether no evidence points to a fault. A silent line alone counts as healthy."""
        return not [c for c in self.causes if c.weight >= 50 and not c.harmless]


@dataclass(frozen=True, slots=True)
class LineCheckOptions:
    """The options of an observation: its duration in seconds, and the unit ID to which a probe is sent (None: nothing is
    sent).
    """

    listen_s: float = 5.0
    probe_unit: int | None = None
    share_bus: bool = False
    bitrate: int = 0
    timeout_s: float = 0.5


async def look_at_line(
    url: str,
    look: LineCheckOptions | None = None,
    *,
    on_progress: Callable[[PhaseProgress], None] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
    taps: Sequence[Tap] = (),
    connector: Connector | None = None,
    clock: Clock | None = None,
) -> LineReport:
    """Observe the line or bus at `url` and return the report.

    Raises `Unreachable` for a serial port or CAN bus that cannot be opened (an unreachable host is explained in the report
    instead), `NotAllowed` for a probe on a line with traffic unless `share_bus` is set.
    """
    endpoint = Endpoint.parse(url)
    looker = _Looker(endpoint, look or LineCheckOptions(), on_progress, stop, taps, connector, clock or WallClock())
    if endpoint.is_can:
        return await looker.at_bus()
    framing_of(endpoint)
    return await (looker.at_line() if endpoint.is_serial else looker.at_host())


class _Looker:
    def __init__(
        self,
        endpoint: Endpoint,
        look: LineCheckOptions,
        on_progress: Callable[[PhaseProgress], None],
        stop: Callable[[], bool],
        taps: Sequence[Tap],
        connector: Connector | None,
        clock: Clock,
    ) -> None:
        self._endpoint, self._look = endpoint, look
        self._tell, self._stop = on_progress, stop
        self._taps, self._connector, self._clock = taps, connector, clock

    # -- serial lines ---------------------------------------------------------------------------------------------

    async def at_line(self) -> LineReport:
        look, report = self._look, LineReport(str(self._endpoint), "serial")
        scanner = ModbusScanner(
            str(self._endpoint),
            ScanOptions(listen_s=look.listen_s, listen_only=True),
            on_progress=self._tell,
            stop=self._stop,
            taps=self._taps,
            connector=self._connector,
            clock=self._clock,
        )
        scan = await scanner.run()
        first = scan.auditions[0]
        report.heard, report.errors = first.heard, first.errors
        settings = first.settings
        control, ignored, counts = await self._port_facts(settings)
        if look.probe_unit is not None and not self._stop():
            if first.heard.bytes and not look.share_bus:
                raise NotAllowed("this line carries traffic", hint="--share-bus sends the probe between its exchanges")
            report.probe = await self._probe(settings, look.probe_unit, quiet=bool(first.heard.bytes))
            report.sent = True
        report.facts = _serial_facts(scan, settings, control, ignored, counts, report.probe)
        report.causes = serial_causes(
            SerialEvidence(
                settings, first.heard, first.errors, scan.verdict, tuple(control.items()), ignored, report.probe
            )
        )
        return report

    async def _port_facts(self, settings: SerialSettings) -> tuple[dict[str, bool], tuple[str, ...], bool]:
        url = str(plan.with_settings(self._endpoint, settings))
        async with bytes_at(url, connector=self._connector, clock=self._clock) as connection:
            ignored = getattr(connection, "ignored", ())
            if not isinstance(connection, CountsErrors):
                return {}, ignored, False
            return connection.control_lines(), ignored, connection.counters() is not None

    async def _probe(self, settings: SerialSettings, unit: int, *, quiet: bool) -> ScanProbe:
        """Send one request, without repetition, and return the classification of the bytes received after it."""
        sweep = UnitSweep(
            framing_of(self._endpoint),
            (unit,),
            timeout_ns=round(self._look.timeout_s * NS_PER_S),
            char_time_ns=round(settings.char_time_s * NS_PER_S),
            quiet_ns=30_000_000 if quiet else 0,
        )
        url, clock, heard, sent = str(plan.with_settings(self._endpoint, settings)), self._clock, bytearray(), b""
        async with bytes_at(url, taps=self._taps, connector=self._connector, clock=clock) as connection:
            while sweep.asked < 2 and (step := sweep.poll(clock.monotonic_ns())) is not None:
                if isinstance(step, SendRequest):
                    if sweep.asked > 1:
                        break  # only one question is sent, which is not repeated even if the answer is damaged
                    sent = step.data
                    await connection.write(sent)
                    sweep.handed_over(clock.monotonic_ns())
                    continue
                data = await connection.read_within(max(0, step.until_ns - clock.monotonic_ns()) / NS_PER_S)
                heard += data
                if data:
                    sweep.feed(data, clock.monotonic_ns())
        return probe_of(unit, sent, bytes(heard), answered=unit in sweep.found)

    # -- CAN ------------------------------------------------------------------------------------------------------

    async def at_bus(self) -> LineReport:
        look = self._look
        if look.probe_unit is not None:
            raise NotAllowed("--probe is for serial lines", hint="`fieldtwin scan` asks its nodes")
        scanner = CanScanner(
            str(self._endpoint),
            CanScanOptions(bitrate=look.bitrate, listen_s=look.listen_s, listen_only=True),
            on_progress=self._tell,
            stop=self._stop,
            taps=self._taps,
            connector=self._connector,
            clock=self._clock,
        )
        scan = await scanner.run()
        assert scan.facts is not None
        heard, facts = scan.heard, scan.facts
        report = LineReport(str(self._endpoint), "can", bus=heard, can=facts)
        load = heard.load(scan.listened_s, scan.bitrate)
        rows = [("listened", f"{scan.listened_s:.1f} s, nothing sent")]
        if scan.bitrate:
            rows.append(("bit rate", f"{scan.bitrate} bit/s"))
        if facts.state:
            rows.append(("controller", f"{facts.state}, errors {facts.tx_errors} sending, {facts.rx_errors} receiving"))
        if facts.interface == "socketcan":
            rows.append(("acknowledges", "no (listen-only)" if facts.listen_only else "yes: the interface is a node"))
        rows.append(("frames", f"{heard.frames}, load {load:.0%}" if scan.bitrate else f"{heard.frames}"))
        rows.append(("error frames", str(heard.errors)))
        if heard.nodes:
            rows.append(("nodes heard", ", ".join(map(str, sorted(heard.nodes)))))
        if heard.sdo_masters:
            rows.append(("another master", f"uses SDO with {', '.join(map(str, sorted(heard.sdo_masters)))}"))
        rows += [("note", note) for note in scan.notes]
        report.facts, report.causes = rows, can_causes(facts, heard, load)
        return report

    # -- hosts ----------------------------------------------------------------------------------------------------

    async def at_host(self) -> LineReport:
        report = LineReport(str(self._endpoint), "tcp")
        began_ns, heard, problem, hung_up = self._clock.monotonic_ns(), b"", "", False
        try:
            async with asyncio.timeout(CONNECT_S):
                connection = await self._open()
        except (Unreachable, TimeoutError) as e:
            problem = e.message if isinstance(e, Unreachable) else "no answer"
            if isinstance(e, EndpointBusy):
                raise
        else:
            took_ms = (self._clock.monotonic_ns() - began_ns) / 1e6
            report.facts.append(("connects", f"in {took_ms:.1f} ms"))
            try:
                heard, hung_up = await self._wait(connection)
            finally:
                await connection.aclose()
            report.facts.append(
                ("stays open", "no: it closes the connection" if hung_up else f"for {self._look.listen_s:g} s")
            )
            report.facts.append(("speaks unasked", f"{len(heard)} bytes" if heard else "no"))
        if problem:
            report.facts.append(("connects", f"no: {problem}"))
        report.facts.append(("sent", "nothing"))
        report.causes = tcp_causes(problem, heard, hung_up, self._endpoint.port)
        return report

    async def _open(self) -> ByteConnection:
        from fieldtwin.gateway.connections.os_connector import OsConnector

        return await (self._connector or OsConnector()).open_bytes(self._endpoint)

    async def _wait(self, connection: ByteConnection) -> tuple[bytes, bool]:
        began_ns, heard = self._clock.monotonic_ns(), b""
        while not self._stop():
            left_s = self._look.listen_s - (self._clock.monotonic_ns() - began_ns) / NS_PER_S
            if left_s <= 0 or len(heard) > 256:
                break
            self._tell(
                PhaseProgress("listening", self._look.listen_s - left_s, self._look.listen_s, f"{len(heard)} bytes")
            )
            try:
                heard += await connection.read_within(min(0.1, left_s))
            except ConnectionLost:
                return heard, True
        return heard, False


def probe_of(unit: int, sent: bytes, heard: bytes, *, answered: bool) -> ScanProbe:
    """Classify the bytes received after a request: its echo, an answer, both, or other bytes."""
    if heard.startswith(sent):
        echo, rest = "whole", heard[len(sent) :]
    elif len(heard) >= len(sent) - 1 and _alike(sent, heard) and not answered:
        echo, rest = "damaged", b""
    else:
        echo, rest = "none", heard
    answer = "good" if answered else "damaged" if rest else "none"
    return ScanProbe(unit, echo, answer, len(heard))


def _alike(sent: bytes, heard: bytes) -> bool:
    """Return whether at least half of the bytes in `heard` equal those in `sent` at the same position."""
    same = sum(a == b for a, b in zip(sent, heard, strict=False))
    return same * 2 >= len(sent)


def _serial_facts(
    scan: ModbusScan,
    settings: SerialSettings,
    control: dict[str, bool],
    ignored: tuple[str, ...],
    counts: bool,
    probe: ScanProbe | None,
) -> list[tuple[str, str]]:
    audition = scan.auditions[0]
    heard, errors = audition.heard, audition.errors
    rows = [
        ("listened at", plan.name_of(settings)),
        ("sent", "nothing" if probe is None else f"one read, to unit {probe.unit}"),
    ]
    if heard.bytes:
        rows.append(("heard", f"{heard.bytes} bytes, {heard.frames} whole frames ({heard.share:.0%} of the bytes)"))
    else:
        rows.append(("heard", "nothing"))
    if errors is None:
        rows.append(("errors counted", "this port has no error counters" if not counts else "none"))
    else:
        rows.append(
            ("errors counted", f"framing {errors.frame}, parity {errors.parity}, breaks {errors.breaks}, "
             f"lost {errors.overrun + errors.buffer_overrun}")
        )  # fmt: skip
    if control:
        rows.append(("control lines", " ".join(name if on else name.lower() for name, on in control.items())))
    if ignored:
        rows.append(("ignored settings", ", ".join(ignored)))
    if scan.verdict is not None:
        rows.append(("settings", describe(scan.verdict)))
    best = scan.heard
    if best is not None and best.live:
        rows.append(("units that answer", ", ".join(map(str, best.live))))
    if best is not None and best.silent:
        rows.append(("units that do not", ", ".join(map(str, best.silent))))
    if probe is not None:
        rows.append(("echo", {"none": "none", "whole": "yes: use --echo", "damaged": "damaged"}[probe.echo]))
        rows.append(("answer", probe.answer))
    else:
        rows.append(("echo", "not tested: --probe UNIT sends one request"))
    return rows
