"""`scan` of a Modbus endpoint: listen, then try the likely settings, then every unit ID.

Other modules without I/O decide which requests are sent; this module sends them. Nothing is sent before the line has been
observed, and nothing at all if traffic was received and the user did not allow sharing the bus.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from fieldtwin.commissioning.access.connection import bytes_at
from fieldtwin.commissioning.access.progress import PhaseProgress
from fieldtwin.commissioning.scan import settings as plan
from fieldtwin.commissioning.scan.listening import (
    Audition,
    LineVerdict,
    dwell_over,
    line_verdict,
    siblings,
    worth_hearing,
)
from fieldtwin.commissioning.scan.odd_replies import OddReply, gathered
from fieldtwin.commissioning.scan.settings import Pace, ScanStep
from fieldtwin.commissioning.scan.shared_unit_ids import SPREAD, SharedUnitIds, detect_shared_unit_ids, spread_over
from fieldtwin.commissioning.scan.sweep import SendRequest, UnitAnswer, UnitSweep
from fieldtwin.commissioning.scan.traffic import Heard, LineListener
from fieldtwin.gateway.connections.serial.line_counters import CountsErrors, UartCounters
from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S, Clock
from fieldtwin.gateway.core.connection import ByteConnection, Connector, Tap
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.core.errors import ConnectionLost, UsageError
from fieldtwin.gateway.protocols.modbus.frames.selection import Framing, framing_of
from fieldtwin.gateway.wallclock import WallClock

SHARED_QUIET_NS = 30 * NS_PER_MS
"""Silence in ns before each request on a line with another client."""
QUICK_TIMEOUT_S, LINE_TIMEOUT_S, SOCKET_TIMEOUT_S = 0.2, 0.6, 1.0
"""Default timeouts of a reply in seconds: for the quick pass on a serial line, for other passes, and for TCP and UDP.

A server of libmodbus takes any frame that arrives within 500 ms after a request to another unit for the answer of that unit.
Only a scan with a longer timeout finds such servers.
"""
MANY_FAILURES = 3
MOST_BREAKS = 3
"""Number of consecutive disconnections by the server during the request to one unit, after which the unit is skipped."""


@dataclass(frozen=True, slots=True)
class ScanOptions:
    """The options of a scan. An option that is None is derived from the endpoint.

    `every_setting`: try all settings even after units were found.
    """

    units: tuple[int, ...] | None = None
    timeout_s: float | None = None
    per_s: float = 20.0
    listen_s: float = 3.0
    quick_s: float = 30.0
    quick_only: bool = False
    listen_only: bool = False
    every_setting: bool = False
    share_bus: bool = False


@dataclass(frozen=True, slots=True)
class FoundUnit:
    """A unit that answered, and the settings at which it answers. `doubtful`: it did not answer a second request."""

    answer: UnitAnswer
    settings: SerialSettings | None
    doubtful: bool = False


@dataclass(slots=True)
class ModbusScan:
    """The findings of a Modbus scan so far; they are complete if `stopped` is False."""

    url: str
    heard: Heard | None = None
    verdict: LineVerdict | None = None
    auditions: list[Audition] = field(default_factory=list)
    units: list[FoundUnit] = field(default_factory=list)
    damaged: list[OddReply] = field(default_factory=list)
    behind_gateway: set[int] = field(default_factory=set)
    alike: SharedUnitIds | None = None
    echo: bool = False
    asked: int = 0
    took_s: float = 0.0
    stopped: bool = False
    notes: list[str] = field(default_factory=list)

    @property
    def sent(self) -> bool:
        return self.asked > 0


class ModbusScanner:
    """One scan of `url`; `run` it once.

    `stop` is called often: when it returns True, `run` ends and the findings are kept.
    """

    def __init__(
        self,
        url: str,
        options: ScanOptions | None = None,
        *,
        on_progress: Callable[[PhaseProgress], None] = lambda _: None,
        stop: Callable[[], bool] = lambda: False,
        taps: Sequence[Tap] = (),
        connector: Connector | None = None,
        clock: Clock | None = None,
    ) -> None:
        self._endpoint = Endpoint.parse(url)
        self._framing: Framing = framing_of(self._endpoint)
        self._options = options or ScanOptions()
        self._tell, self._stop = on_progress, stop
        self._taps, self._connector, self._clock = taps, connector, clock or WallClock()
        serial = self._endpoint.is_serial
        timeout_s = self._options.timeout_s or (LINE_TIMEOUT_S if serial else SOCKET_TIMEOUT_S)
        self._pace = Pace(timeout_s, 1 / self._options.per_s, self._framing == "ascii")
        self._quick = replace(self._pace, timeout_s=self._options.timeout_s or QUICK_TIMEOUT_S)
        self._units = self._options.units or (plan.SERIAL_UNITS if serial else plan.TCP_UNITS)
        if serial and not all(1 <= u <= 247 for u in self._units):
            raise UsageError("units of a serial line", expected="1 to 247", got=str(self._units))
        self._met_master = False
        self.result = ModbusScan(url)

    async def run(self) -> ModbusScan:
        """Run the scan.

        Raises `Unreachable` if the endpoint cannot be opened; after later errors `result` has the findings.
        """
        began_ns = self._clock.monotonic_ns()
        try:
            if self._endpoint.is_serial:
                await self._scan_line()
            else:
                await self._scan_socket()
            self._doubt()
        finally:
            self.result.took_s = (self._clock.monotonic_ns() - began_ns) / NS_PER_S
            self.result.stopped = self._stop()
        return self.result

    def _doubt(self) -> None:
        """Add a note if several units answer only with exception 04h: the scan counts every exception as an answer of a unit,
        but some servers send this one for units that do not exist.
        """
        failures = [f.answer.unit for f in self.result.units if f.answer.exception == 4]
        if len(failures) >= MANY_FAILURES:
            self.result.notes.append(
                f"{len(failures)} units answer only with exception 04h, as some servers do for units that they do not have"
            )

    @property
    def _ended(self) -> bool:
        """Return whether the scan must send no more requests."""
        return self._met_master or self._stop()

    def planned(self) -> list[tuple[str, list[ScanStep]]]:
        """Return the steps of `run` after listening, as pairs of phase and steps, for the case that no unit answers."""
        if not self._endpoint.is_serial:
            first = spread_over(self._units)
            rest = [u for u in self._units if u not in first]
            return [("some units", [self._pace.step(None, first)]), ("every unit", [self._pace.step(None, rest)])]
        said = plan.stated_settings(self._endpoint)
        if said is not None:
            return [("every unit", [self._pace.step(said, self._units)])]
        likely = plan.likely_settings(self._endpoint)
        phases = [("likely settings", plan.quick_pass(self._quick, likely, self._units, self._options.quick_s))]
        if not self._options.quick_only:
            every = plan.all_settings(self._endpoint)
            phases.append(("every setting", plan.full_pass(self._pace, every, self._units)))
        return phases

    # -- a serial line --------------------------------------------------------------------------------------------

    async def _scan_line(self) -> None:
        said = plan.stated_settings(self._endpoint)
        if not await self._listen(said):
            return
        verdict = self.result.verdict
        here = said if verdict is None or (said is not None and said in verdict.fits) else verdict.settings
        if here is None:
            await self._search()
            return
        await self._steps([self._pace.step(here, self._units)], "every unit")
        if self._options.every_setting and not self._ended:
            await self._search_all([self._pace.step(here, self._units)])

    async def _search(self) -> None:
        """Search for units on a silent line whose settings are not known, the likely settings first."""
        steps = plan.quick_pass(self._quick, plan.likely_settings(self._endpoint), self._units, self._options.quick_s)
        done = await self._steps(steps, "likely settings", until_found=not self._options.every_setting)
        if self._quick != self._pace:
            done = []  # some units were asked too quickly, so they are asked again
        if self._options.quick_only:
            self.result.notes.append("only likely settings and units were tried; omit --quick to try all")
            return
        found = {f.settings for f in self.result.units}
        if found:
            await self._steps(plan.full_pass(self._pace, list(found), self._units, done), "every unit")
        if self._ended or (found and not self._options.every_setting):
            return
        await self._search_all(done)

    async def _search_all(self, done: list[ScanStep]) -> None:
        every = plan.all_settings(self._endpoint)
        steps = plan.full_pass(self._pace, every, self._units, done)
        await self._steps(steps, "every setting", until_found=not self._options.every_setting)

    async def _listen(self, said: SerialSettings | None) -> bool:
        """Listen to the line, and return whether requests may follow. `said` are the settings that the user stated (None: not
        stated).
        """
        options, result = self._options, self.result
        likely = [*plan.likely_settings(self._endpoint), *plan.likely_settings(replace(self._endpoint, params=()))]
        first = said or likely[0]  # the settings that the user stated may be wrong, which traffic shows
        audition = await self._audition(first, options.listen_s, whole=True)
        result.auditions.append(audition)
        result.heard = audition.heard
        if not audition.heard.bytes:
            return not (options.listen_only or self._stop())
        waiting = worth_hearing(first, likely)[1:]
        while waiting and not self._stop():
            verdict = line_verdict(result.auditions)
            if verdict is not None and verdict.sure:
                break
            best = max(result.auditions, key=lambda a: (a.heard.sure, a.heard.share))
            if best.heard.share > 0.2:  # the baud rate is right, and only the parity is unknown
                kin = [s for s in siblings(best.settings) if s not in [a.settings for a in result.auditions]]
                if not kin:
                    break
                waiting = kin
            result.auditions.append(await self._audition(waiting.pop(0), 0.0))
        found = line_verdict(result.auditions)
        if found is not None and found.settings != first and not self._stop():  # listen for longer, to hear other units
            longer = await self._audition(found.settings, options.listen_s, whole=True)
            result.auditions = [longer if a.settings == longer.settings else a for a in result.auditions]
        result.verdict = line_verdict(result.auditions)
        if result.verdict is not None:
            result.heard = result.verdict.heard
        if options.listen_only or self._stop():
            return False
        if not options.share_bus:
            result.notes.append(
                "this line carries traffic, so nothing was sent; --share-bus sends between its exchanges"
            )
            return False
        if result.verdict is None:
            result.notes.append("the received bytes are not valid with any settings, so nothing was sent")
            return False
        if not result.verdict.sure and said not in result.verdict.fits:
            result.notes.append(
                "the settings are not certain, and wrong ones would disturb other devices: set baudrate and frame"
            )
            return False
        return True

    async def _audition(self, settings: SerialSettings, listen_s: float, *, whole: bool = False) -> Audition:
        """Listen at `settings` until the result is clear; with `whole`, for at least `listen_s` seconds."""
        listener = LineListener(self._framing)
        url = str(plan.with_settings(self._endpoint, settings))
        async with bytes_at(url, taps=self._taps, connector=self._connector, clock=self._clock) as connection:
            before = _counters(connection)
            began_ns = self._clock.monotonic_ns()
            while not self._stop():
                elapsed_s = (self._clock.monotonic_ns() - began_ns) / NS_PER_S
                clear = dwell_over(listener.heard, elapsed_s)
                if (clear or not listener.heard.bytes) and elapsed_s >= listen_s if whole else clear:
                    break
                detail = f"{plan.name_of(settings)}, {listener.heard.bytes} bytes, {listener.heard.frames} frames"
                self._tell(PhaseProgress("listening", elapsed_s, max(listen_s, elapsed_s), detail))
                data = await connection.read_within(0.1)
                listener.feed(data, self._clock.monotonic_ns())
            listener.settle(self._clock.monotonic_ns() + NS_PER_S)
            after = _counters(connection)
            errors = after.since(before) if after is not None and before is not None else None
        return Audition(settings, listener.heard, errors)

    # -- questions ------------------------------------------------------------------------------------------------

    async def _steps(self, steps: list[ScanStep], phase: str, *, until_found: bool = False) -> list[ScanStep]:
        """Run `steps`; return those that were begun."""
        total_s, done_s = plan.seconds_of(steps), 0.0
        for i, step in enumerate(steps):
            if self._ended:
                return steps[:i]
            before = len(self.result.units)
            await self._step(step, partial(self._told, phase, done_s, total_s))
            done_s += step.seconds
            if self._ended or (until_found and len(self.result.units) > before):
                return steps[: i + 1]
        return steps

    def _told(self, phase: str, done_s: float, total_s: float, step: ScanStep, sweep: UnitSweep) -> None:
        where = f"{plan.name_of(step.settings)}, " if step.settings else ""
        part = sweep.asked / max(1, sweep.asked + sweep.left)
        found = len(self.result.units) + len(sweep.found)
        self._tell(PhaseProgress(phase, done_s + part * step.seconds, total_s, f"{where}unit {sweep.asking}", found))

    async def _step(self, step: ScanStep, on_question: Callable[[ScanStep, UnitSweep], None]) -> None:
        settings = step.settings
        endpoint = plan.with_settings(self._endpoint, settings) if settings else self._endpoint
        shared = self.result.heard is not None and self.result.heard.bytes > 0
        sweep = UnitSweep(
            self._framing,
            step.units,
            timeout_ns=round(step.timeout_s * NS_PER_S),
            char_time_ns=round(settings.char_time_s * NS_PER_S) if settings else 0,
            interval_ns=round(step.interval_s * NS_PER_S),
            quiet_ns=SHARED_QUIET_NS if shared else 0,
        )
        try:
            await self._drive(sweep, endpoint, lambda: on_question(step, sweep))
            lost = await self._confirm(sweep, endpoint) if sweep.found and not self._ended else set()
        finally:
            self._keep(sweep, settings)
        for unit in lost:
            self.result.notes.append(f"unit {unit} answered once, but not when it was asked again")
        self.result.units = [
            replace(f, doubtful=True) if f.settings == settings and f.answer.unit in lost else f
            for f in self.result.units
        ]

    async def _drive(self, sweep: UnitSweep, endpoint: Endpoint, on_question: Callable[[], None]) -> None:
        """Run the sweep until a request was sent to each unit, reopening the connection whenever the server closes it."""
        breaks, last_asked = 0, -1
        while True:
            url = str(endpoint)
            async with bytes_at(url, taps=self._taps, connector=self._connector, clock=self._clock) as connection:
                try:
                    await self._ask(sweep, connection, on_question)
                    return
                except ConnectionLost:
                    breaks = breaks + 1 if sweep.asked == last_asked + 1 else 1
                    sweep.ask_again()
                    last_asked = sweep.asked
                    if breaks >= MOST_BREAKS:
                        if endpoint.is_serial:
                            raise
                        unit, breaks = sweep.skip(), 0
                        self.result.notes.append(f"the server closes the connection whenever unit {unit} is asked")

    async def _ask(self, sweep: UnitSweep, connection: ByteConnection, on_question: Callable[[], None]) -> None:
        clock = self._clock
        while not self._ended and (step := sweep.poll(clock.monotonic_ns())) is not None:
            if isinstance(step, SendRequest):
                on_question()
                await connection.write(step.data)
                sweep.handed_over(clock.monotonic_ns())
                continue
            data = await connection.read_within(max(0, step.until_ns - clock.monotonic_ns()) / NS_PER_S)
            if data:
                sweep.feed(data, clock.monotonic_ns())
            if sweep.other_requests and not self._options.share_bus:
                # the other client was silent while the scan listened: stop as if its traffic had been received then
                self._met_master = True
                self.result.notes.append(
                    "another client started to send, so the scan stopped; --share-bus continues between its exchanges"
                )
                return

    async def _confirm(self, sweep: UnitSweep, endpoint: Endpoint) -> set[int]:
        """Send a second request to the first unit and to those that answered late, because a valid check sum may be due to
        chance. Return the units that do not answer.
        """
        first = {next(iter(sweep.found)), *(u for u, a in sweep.found.items() if a.late)}
        again = sweep.another(first)
        await self._drive(again, endpoint, lambda: None)
        return first - set(again.found) if not self._ended else set()

    def _keep(self, sweep: UnitSweep, settings: SerialSettings | None) -> None:
        result = self.result
        result.asked += sweep.asked
        result.echo = result.echo or sweep.echo
        result.units = [f for f in result.units if f.settings != settings or f.answer.unit not in sweep.found]
        result.units += [FoundUnit(sweep.found[u], settings) for u in sorted(sweep.found)]
        result.damaged = gathered(result.damaged, sweep.damaged, settings)
        result.behind_gateway |= sweep.behind_gateway
        if sweep.never_silent:
            result.notes.append(
                "the line is never silent: another client on the line, or a unit that sends continuously"
            )
        if settings is not None:
            alike = detect_shared_unit_ids([f.answer for f in result.units if f.settings == settings], sweep.asked)
            result.alike = alike or result.alike

    # -- a host ---------------------------------------------------------------------------------------------------

    async def _scan_socket(self) -> None:
        """Scan a TCP or UDP endpoint. A sample of unit IDs is tried first: if all answer with the same bytes, one device
        serves all IDs, and the scan ends unless `every_setting` is set.
        """
        first = spread_over(self._units)
        if len(first) < SPREAD:
            await self._steps([self._pace.step(None, self._units)], "every unit")
            return
        sample = self._pace.step(None, first)
        rest = plan.full_pass(self._pace, [None], self._units, [sample])
        await self._steps([sample], "some units")
        answers = [f.answer for f in self.result.units]
        self.result.alike = detect_shared_unit_ids(answers, len(first))
        if self.result.alike is None and len(answers) == len(first) and not self._ended:
            self.result.alike = await self._ask_once_more(answers, first)
        if self.result.alike is not None and self.result.alike.one_device and not self._options.every_setting:
            self.result.notes.append(f"{len(first)} unit IDs asked, all with the same answer: the rest was not asked")
            return
        if not self._ended:
            await self._steps(rest, "every unit")
        self.result.units.sort(key=lambda f: f.answer.unit)

    async def _ask_once_more(self, answers: list[UnitAnswer], units: tuple[int, ...]) -> SharedUnitIds | None:
        """Send a second request to all units, if their answers differed. This shows whether one device with a changing
        register answered, or several devices.
        """
        sweep = UnitSweep(
            self._framing, units, timeout_ns=round(self._pace.timeout_s * NS_PER_S),
            interval_ns=round(self._pace.interval_s * NS_PER_S),
        )  # fmt: skip
        await self._drive(sweep, self._endpoint, lambda: None)
        self.result.asked += sweep.asked
        return detect_shared_unit_ids(answers, len(units), again=list(sweep.found.values()))


def _counters(connection: ByteConnection) -> UartCounters | None:
    return connection.counters() if isinstance(connection, CountsErrors) else None
