"""The time around a failure, extracted from a trace: frames on the buses, states of programs, values of tags.

All windows of a scenario are filled in one pass over the events; each keeps at most `MOST_FRAMES` frames before the
failure, `MOST_EXCHANGES` exchanges, and `MOST_STEPS` changes of each tag and state. This module draws nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

from fieldtwin.capture.decoding.decoder import Decoder
from fieldtwin.capture.decoding.exchange import SECRET, DecodedExchange
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.reports.run.coverage import Collector
from fieldtwin.results.model import AccessCounts, CheckResult, Report, ScenarioResult
from fieldtwin.results.trace import TraceEvent, TraceKind

MOST_FRAMES = 160
"""Largest number of frames before the failure; after it, a quarter as many are kept."""
MOST_STEPS = 600
MOST_EXCHANGES = 1500
LONGEST_NS = 60 * NS_PER_S
"""Longest time before a failure that is drawn."""


@dataclass(frozen=True, slots=True)
class PlotStep:
    """A tag or state that has had `value` since `t_ns`. `quality` is "" for a state."""

    t_ns: int
    value: Any
    quality: str = ""
    reason: str = ""


@dataclass(frozen=True, slots=True)
class FaultBar:
    """A fault that was active from `on_ns` to `off_ns` (None: it was still active at the end of the trace)."""

    id: str
    name: str
    target: str
    on_ns: int
    off_ns: int | None


@dataclass(frozen=True, slots=True)
class FrameLine:
    """A frame in the shown part of a run, described in words."""

    t_ns: int
    bus: str
    sent: bool
    raw: str
    text: str


@dataclass
class Window:
    """The window around `check`, from `start_ns` to `end_ns`.

    `cut` is the number of frames that were left out. `lost`: the trace begins only after `start_ns`.
    """

    check: CheckResult
    start_ns: int
    end_ns: int
    at_ns: int
    lost: bool = False
    exchanges: list[DecodedExchange] = field(default_factory=list)
    states: dict[str, list[PlotStep]] = field(default_factory=dict)
    tags: dict[str, list[PlotStep]] = field(default_factory=dict)
    faults: list[FaultBar] = field(default_factory=list)
    before: deque[FrameLine] = field(default_factory=lambda: deque(maxlen=MOST_FRAMES))
    after: list[FrameLine] = field(default_factory=list)
    bad: dict[tuple[str, int], str] = field(default_factory=dict)
    """The problem of each frame that has one, by bus and time."""
    frames: int = 0
    thinned: set[str] = field(default_factory=set)
    """Buses, tags and variables of which only a part is kept, because there were too many events."""

    @property
    def lines(self) -> list[FrameLine]:
        """Return the frames that were kept, in order."""
        return [*self.before, *self.after]

    @property
    def cut(self) -> int:
        return self.frames - len(self.before) - len(self.after)

    @property
    def span_ns(self) -> int:
        return max(1, self.end_ns - self.start_ns)


def around(check: CheckResult, end_ns: int) -> Window | None:
    """Return the empty window around the time of a check's verdict; None for a check without a verdict."""
    if check.t_ns is None:
        return None
    at = check.t_ns
    since = check.since_ns if check.since_ns is not None else at
    led_up = min(LONGEST_NS, max(NS_PER_S, (at - since) * 6 // 5))
    behind = max(NS_PER_S // 4, led_up // 6)
    return Window(check, max(0, at - led_up), min(at + behind, max(end_ns, at + behind // 4)), at)


class Study:
    """One pass over a scenario's trace: its counts, and the windows around the given checks."""

    def __init__(self, report: Report, scenario: ScenarioResult) -> None:
        self._decoder = Decoder(report.system, report.served, report.framings)
        self._collector = Collector(report.system, report.machines)
        self._machines = {m.variable: m for m in report.machines}
        self._scenario = scenario
        devices = report.system.devices.values() if report.system else ()
        self._secrets = {f"{d.name}.{t.name}" for d in devices for t in d.profile.tags.values() if t.secret}
        self._hiding = {d.bus for d in devices if any(t.secret for t in d.profile.tags.values())}
        self._now: dict[TraceKind, dict[str, PlotStep]] = {TraceKind.TAG: {}, TraceKind.STATE: {}}
        self._on: dict[str, FaultBar] = {}
        self._off: list[FaultBar] = []

    def run(self, checks: Sequence[CheckResult]) -> tuple[AccessCounts, list[Window]]:
        """Read the scenario's trace and return its counts and windows.

        If a listener has already counted, its counts are returned.
        """
        trace = self._scenario.trace
        end_ns = trace[-1].t_ns if trace else 0
        windows = [w for w in (around(c, end_ns) for c in checks) if w is not None and trace]
        first_ns = trace[0].t_ns if trace else 0
        for window in windows:
            window.lost = bool(self._scenario.dropped) and first_ns > window.start_ns
        begun: set[int] = set()
        for event in trace:
            for number, window in enumerate(windows):
                if number not in begun and event.t_ns >= window.start_ns:
                    begun.add(number)
                    self._begin(window)
            self._event(event, [w for w in windows if w.start_ns <= event.t_ns <= w.end_ns], windows)
            if len(self._off) > MOST_STEPS:
                self._off = [b for b in self._off if any((b.off_ns or 0) >= w.start_ns for w in windows)][-MOST_STEPS:]
        rest = self._decoder.finish()
        self._collector.add(rest)
        for exchange in rest:
            self._exchange(exchange, windows)
        for window in windows:
            bars = [*self._off, *self._on.values()]
            window.faults = [
                b for b in bars if b.on_ns <= window.end_ns and (b.off_ns is None or b.off_ns >= window.start_ns)
            ]
        counts = self._scenario.counts
        return (self._collector.finish() if counts is None else counts), windows

    def _begin(self, window: Window) -> None:
        """Start a window with the current values and states."""
        window.tags = {name: [step] for name, step in self._now[TraceKind.TAG].items()}
        window.states = {name: [step] for name, step in self._now[TraceKind.STATE].items()}

    def _event(self, event: TraceEvent, inside: list[Window], windows: list[Window]) -> None:
        data = event.data
        done: tuple[DecodedExchange, ...] = ()
        if event.kind is TraceKind.FRAME:
            if inside:
                decoded = self._decoder.decode(event)
                done = decoded.exchanges
                line = FrameLine(
                    event.t_ns,
                    event.where,
                    data.get("dir") == "sent",
                    _raw(event, decoded.text, self._hiding),
                    decoded.text,
                )
                for window in inside:
                    _keep(window, line)
            else:
                done = tuple(self._decoder.feed(event))
            for exchange in done:
                self._exchange(exchange, windows)
        elif event.kind in (TraceKind.TAG, TraceKind.STATE):
            self._changed(event, inside)
        elif event.kind is TraceKind.FAULT:
            self._fault(event)
        self._collector.take(event, done)

    def _exchange(self, exchange: DecodedExchange, windows: list[Window]) -> None:
        for window in windows:
            if exchange.t_ns <= window.end_ns and exchange.end_ns >= window.start_ns:
                window.exchanges.append(exchange)
                if exchange.problem and len(window.bad) < MOST_EXCHANGES:
                    window.bad[exchange.bus, exchange.end_ns] = exchange.problem
                if len(window.exchanges) > MOST_EXCHANGES:
                    _thin_exchanges(window)

    def _changed(self, event: TraceEvent, inside: list[Window]) -> None:
        data, name, value = event.data, event.where, event.data.get("value")
        machine = self._machines.get(name)
        if event.kind is TraceKind.TAG and name in self._secrets:
            value = SECRET
        step = PlotStep(
            event.t_ns, machine.name_of(value) if machine else value, data.get("quality", ""), data.get("reason", "")
        )
        self._now[event.kind][name] = step
        for window in inside:
            steps = (window.tags if event.kind is TraceKind.TAG else window.states).setdefault(name, [])
            steps.append(step)
            if len(steps) > MOST_STEPS:
                window.thinned.add(name)
                steps[:] = thin_steps(steps)

    def _fault(self, event: TraceEvent) -> None:
        id, on = event.where, bool(event.data.get("on"))
        known = self._on.pop(id, None)
        if known is not None:
            self._off.append(FaultBar(id, known.name, known.target, known.on_ns, event.t_ns))
        if on:
            target = event.data.get("target") or ""
            self._on[id] = FaultBar(id, str(event.data.get("name", id)), str(target), event.t_ns, None)


def _thin_exchanges(window: Window) -> None:
    """Remove half of the exchanges without a problem; if nearly all have one, remove the older half."""
    held = window.exchanges
    window.thinned |= {e.bus for e in held if e.ok}
    held[:] = [e for number, e in enumerate(held) if e.problem or number % 2]
    if len(held) > MOST_EXCHANGES * 3 // 4:
        window.thinned |= {e.bus for e in held}
        del held[: len(held) // 2]


def thin_steps(steps: list[PlotStep]) -> list[PlotStep]:
    """Return about half of the steps: of every four changes the lowest and the highest, and all that change the
    quality; if that is most of them, the newer half. The result keeps the extremes."""
    kept = set()
    for first in range(0, len(steps), 4):
        four = range(first, min(first + 4, len(steps)))
        kept |= {min(four, key=lambda i: _height(steps[i])), max(four, key=lambda i: _height(steps[i]))}
    kept |= {i for i, s in enumerate(steps) if s.quality != steps[i - 1].quality} | {len(steps) - 1}
    thin = [steps[i] for i in sorted(kept)]
    return thin if len(thin) < len(steps) * 3 // 4 else thin[len(thin) // 2 :]


def _height(step: PlotStep) -> float:
    value = step.value
    return value if isinstance(value, int | float) and value == value else 0.0


def _keep(window: Window, line: FrameLine) -> None:
    window.frames += 1
    if line.t_ns <= window.at_ns:
        window.before.append(line)
    elif len(window.after) < MOST_FRAMES // 4:
        window.after.append(line)


def _raw(event: TraceEvent, text: str, hiding: Collection[str]) -> str:
    """Return the frame's bytes in hexadecimal, after a CAN identifier if there is one.

    A frame whose text hides a secret is hidden, and so is a partial frame on a bus with secret tags.
    """
    data = event.data
    if SECRET in text or (not text and event.where in hiding):
        return SECRET
    raw = " ".join(data.get("bytes", "")[i : i + 2] for i in range(0, len(data.get("bytes", "")), 2))
    return f"{data['id']:03X} # {raw}" if isinstance(data.get("id"), int) else raw
