"""A timing diagram of a window as inline SVG: faults, wires, program states and values under one time axis.

Each lane is a block of a fixed height; what does not fit as text is in the title of its mark (shown when pointed at) and in
the table of frames below. Colours are the page's variables, so that light, dark and print each have their own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from fieldtwin.decoding.exchange import Exchange
from fieldtwin.decoding.tags import show_value
from fieldtwin.report.markup import Markup, el
from fieldtwin.report.window import SECOND_NS, FaultBar, Step, Window, thin_steps
from twin.system import System

WIDTH = 1180.0
LEFT = 176.0
RIGHT = 14.0
_CHAR = 6.3
"""Width of a character of the 10.5 px monospace face, in px."""
MOST_TAGS = 10
MOST_STATES = 6
MOST_BUSES = 6
MOST_FAULTS = 8
MOST_MARKS = 250
"""Marks of a lane; more would only be black."""
MOST_POINTS = 300
_QUALITIES = {"": "good", "good": "good", "simulated": "good", "substituted": "doubt", "uncertain": "doubt"}


@dataclass
class _Axis:
    """From times to places."""

    start_ns: int
    span_ns: int

    def x(self, t_ns: int) -> float:
        share = (t_ns - self.start_ns) / self.span_ns
        return LEFT + min(max(share, 0.0), 1.0) * (WIDTH - LEFT - RIGHT)


def timing_diagram(window: Window, system: System | None, title: str) -> Markup:
    """The drawing."""
    axis = _Axis(window.start_ns, window.span_ns)
    lanes: list[tuple[float, list[Markup]]] = []
    lanes += [_fault_lane(axis, bar) for bar in window.faults[:MOST_FAULTS]]
    lanes += [_wire_lane(axis, window, bus, system) for bus in _buses(window)]
    lanes += [_state_lane(axis, window, name) for name in _states(window)]
    lanes += [_tag_lane(axis, window, name, system) for name in _tags(window)]
    top, parts = 30.0, []
    for number, (height, marks) in enumerate(lanes):
        stripe = el("rect", cls=f"stripe{number % 2}", x=0.0, y=0.0, width=WIDTH, height=height)
        parts.append(el("g", stripe, marks, transform=f"translate(0 {top:.0f})"))
        top += height + 2
    height = top + 6
    return el(
        "svg",
        el("title", title),
        parts,
        _time_axis(axis, window, height),
        _failure(axis, window, height),
        cls="timing", viewBox=f"0 0 {WIDTH:.0f} {height:.0f}", role="img", xmlns="http://www.w3.org/2000/svg",
    )  # fmt: skip


# -- which lanes ------------------------------------------------------------------------------------------------------


def _buses(window: Window) -> list[str]:
    named = {name.partition(".")[0] for name in window.check.names}
    buses = dict.fromkeys(e.bus for e in window.exchanges)
    about = {e.bus for e in window.exchanges if e.device in named or e.bus in named}
    return sorted(buses, key=lambda b: b not in about)[:MOST_BUSES]


def _states(window: Window) -> list[str]:
    """Those named, then text (states of machines), then what changed most."""
    return _ranked(window, window.states)[:MOST_STATES]


def _tags(window: Window) -> list[str]:
    return _ranked(window, window.tags)[:MOST_TAGS]


def _ranked(window: Window, lanes: dict[str, list[Step]]) -> list[str]:
    names = window.check.names
    devices = {name.partition(".")[0] for name in names}

    def rank(name: str) -> tuple[int, int, int]:
        steps = lanes[name]
        about = 0 if name in names else 1 if name.partition(".")[0] in devices else 2
        words = not any(isinstance(s.value, str) for s in steps)
        return about, int(words), -len({(str(s.value), s.quality) for s in steps})

    return sorted(lanes, key=rank)


# -- lanes --------------------------------------------------------------------------------------------------------------


def _label(name: str, below: str = "") -> list[Markup]:
    most = int((LEFT - 14) / _CHAR)
    shown = name if len(name) <= most else name[: most // 2 - 1] + "…" + name[-(most - most // 2) :]
    parts = [el("text", el("title", name), shown, cls="lane", x=8.0, y=15.0)]
    if below:
        parts.append(el("text", below[: most + 2], cls="sub", x=8.0, y=28.0))
    return parts


def _fault_lane(axis: _Axis, bar: FaultBar) -> tuple[float, list[Markup]]:
    x1, x2 = axis.x(bar.on_ns), axis.x(bar.off_ns) if bar.off_ns is not None else WIDTH - RIGHT
    said = f"{bar.name} {bar.target}".strip()
    off = f"to {_seconds(bar.off_ns)}" if bar.off_ns is not None else "and not taken away"
    box = el(
        "rect", el("title", f"fault {bar.id}: {said}, from {_seconds(bar.on_ns)} {off}"), cls="fault",
        x=x1, y=3.0, width=max(2.0, x2 - x1), height=16.0, rx=2,
    )  # fmt: skip
    return 22.0, [*_label(f"fault {bar.id}"), box, *_fitted(said, x1, x2, 15.0, "faulttext")]


def _wire_lane(axis: _Axis, window: Window, bus: str, system: System | None) -> tuple[float, list[Markup]]:
    """Requests that wait for an answer are boxes as long as the wait, messages are ticks; words where there is room."""
    config = system.buses.get(bus) if system else None
    timeout_ns = round((config.timeout_s if config else 1.0) * SECOND_NS)
    exchanges = sorted((e for e in window.exchanges if e.bus == bus), key=lambda e: e.t_ns)
    marks = _label(bus, config.endpoint.scheme.upper() if config else "")
    rows = sorted({_row(e) for e in exchanges})
    edges = dict.fromkeys(rows, 0.0)
    step = max(1, math.ceil(len(exchanges) / MOST_MARKS))
    for number, exchange in enumerate(exchanges):
        if number % step and exchange.ok:
            continue
        kind, row = _kind(exchange), rows.index(_row(exchange))
        x1, waited = axis.x(exchange.t_ns), exchange.latency_ns
        if kind == "lost":
            following = exchanges[number + 1].t_ns if number + 1 < len(exchanges) else exchange.t_ns + timeout_ns
            waited = min(timeout_ns, max(0, following - exchange.t_ns))
        x2, top = max(x1 + 2.2, axis.x(exchange.t_ns + (waited or 0))), 18.0 + 32 * row
        size = {"x": x1, "y": top, "width": x2 - x1, "height": 12.0, "rx": 1}
        marks.append(el("rect", el("title", _tooltip(exchange)), cls=f"x {kind}", **size))
        words = _short(exchange)
        if x1 >= edges[_row(exchange)] and x1 + len(words) * _CHAR < WIDTH:
            marks.append(el("text", words, cls=f"words {kind}", x=x1, y=top - 4))
            edges[_row(exchange)] = x1 + len(words) * _CHAR + 10
    thinned = step > 1 or bus in window.thinned
    if thinned:
        marks.append(el("text", "thinned: too many", cls="sub", x=8.0, y=41.0))
    return max(36.0, 4.0 + 32 * len(rows)) + (10 if thinned else 0), marks


def _row(exchange: Exchange) -> int:
    """Requests and what waits for them above, messages below."""
    return 0 if exchange.latency_ns is not None or exchange.problem == "no reply" else 1


def _kind(exchange: Exchange) -> str:
    if exchange.ok:
        return "message" if exchange.latency_ns is None else "asked" if not exchange.writes() else "wrote"
    return {"no reply": "lost", "exception": "refused", "abort": "refused"}.get(exchange.problem, "broken")


def _short(exchange: Exchange) -> str:
    """A few words on what it was: the service and where, or what went wrong."""
    if exchange.problem == "exception" and exchange.exception is not None:
        return f"exception {exchange.exception:02X}"
    if exchange.problem == "abort" and exchange.abort is not None:
        return f"abort {exchange.abort:08X}h"
    if exchange.problem:
        return f"{exchange.device or f'unit {exchange.unit}'}: {exchange.problem}"
    text = (
        exchange.text.partition(": ")[2]
        if exchange.device and exchange.text.startswith(exchange.device)
        else exchange.text
    )
    verb = {"read holding registers": "read", "read input registers": "read", "write registers": "write"}
    for long, short in verb.items():
        if text.startswith(long):
            where = exchange.spans[0] if exchange.spans else ""
            text = f"{short} {str(where).partition(' ')[0]}"
    name = exchange.device or (f"unit {exchange.unit}" if exchange.unit else "")
    said = f"{name} {text}".strip()
    return said if len(said) <= 46 else said[:45] + "…"


def _tooltip(exchange: Exchange) -> str:
    took = f", {exchange.latency_ns / 1e6:.3g} ms" if exchange.latency_ns is not None else ""
    answer = f"\n{exchange.reply_text}{took}" if exchange.reply_text else ""
    return f"{_seconds(exchange.t_ns)}  {exchange.text}{answer}"[:240]


def _state_lane(axis: _Axis, window: Window, name: str) -> tuple[float, list[Markup]]:
    return 26.0, [*_label(name), *_boxes(axis, window, window.states[name], 4.0, "state")]


def _tag_lane(axis: _Axis, window: Window, name: str, system: System | None) -> tuple[float, list[Markup]]:
    """A number as a stepped line over its quality, everything else as boxes."""
    steps = _thinned(window.tags[name])
    numbers = [s.value for s in steps if _is_number(s.value)]
    unit = _unit(system, name)
    if not numbers:
        return 26.0, [*_label(name), *_boxes(axis, window, steps, 4.0, "value")]
    low, high = min(numbers), max(numbers)
    height, room = 44.0, 30.0

    def y(value: float) -> float:
        return 8.0 + room * (0.5 if high == low else 1 - (value - low) / (high - low))

    bounds = f"{_number(low)} … {_number(high)} {unit}" if high != low else f"{_number(low)} {unit}"
    thinned = name in window.thinned or len(steps) < len(window.tags[name])
    marks = [*_label(name, bounds), *([el("text", "thinned", cls="sub", x=8.0, y=40.0)] if thinned else [])]
    lines: list[Markup] = []
    paths: dict[str, list[str]] = {}
    for step, end_ns in _spans(window, steps):
        if _is_number(step.value):
            x1, x2 = axis.x(step.t_ns), axis.x(end_ns)
            paths.setdefault(_quality(step), []).append(f"M{x1:.1f} {y(step.value):.1f}H{max(x2, x1 + 1):.1f}")
    for step, end_ns in _merged(window, steps, by_quality=True):
        x1, x2, kind = axis.x(step.t_ns), axis.x(end_ns), _quality(step)
        if kind == "good":
            continue
        why = f"{step.quality}" + (f": {step.reason}" if step.reason not in ("", "none") else "")
        size = {"x": x1, "y": 3.0, "width": max(1.0, x2 - x1), "height": height - 6}
        marks.append(el("rect", el("title", f"{_seconds(step.t_ns)}  {name} {why}"), cls=f"q {kind}", **size))
        lines += _fitted(why, x1, x2, 14.0, f"qtext {kind}", cut=True)
    lines += [el("path", cls=f"line {kind}", d="".join(d)) for kind, d in paths.items()]
    lines.append(_risers(axis, steps, y))
    return height, marks + lines


def _thinned(steps: list[Step]) -> list[Step]:
    while len(steps) > MOST_POINTS:
        steps = thin_steps(steps)
    return steps


def _risers(axis: _Axis, steps: Sequence[Step], y: object) -> Markup:
    """The upright pieces between two values that follow each other."""
    assert callable(y)
    parts = [
        f"M{axis.x(b.t_ns):.1f} {y(a.value):.1f}V{y(b.value):.1f}"
        for a, b in pairwise(steps)
        if _is_number(a.value) and _is_number(b.value) and a.value != b.value
    ]
    return el("path", cls="riser", d="".join(parts)) if parts else Markup("")


def _boxes(axis: _Axis, window: Window, steps: Sequence[Step], top: float, cls: str) -> list[Markup]:
    """Each value from its beginning to its end, with a slanted edge, as logic analysers draw them."""
    marks = []
    for step, end_ns in _merged(window, steps):
        x1, x2 = axis.x(step.t_ns), axis.x(end_ns)
        bad = "" if _quality(step) == "good" else f", {step.quality}: {step.reason}"
        said = (step.value if isinstance(step.value, str) else show_value(step.value)) or "''"
        slant = min(3.0, (x2 - x1) / 2)
        d = f"M{x1:.1f} {top + 9:.1f}l{slant:.1f} -9H{x2 - slant:.1f}l{slant:.1f} 9l{-slant:.1f} 9H{x1 + slant:.1f}z"
        marks.append(el("path", el("title", f"{_seconds(step.t_ns)}  {said}{bad}"), cls=f"{cls} {_quality(step)}", d=d))
        marks += _fitted(said + (f" ({step.reason})" if bad else ""), x1 + 2, x2, top + 13, f"{cls}text", cut=True)
    return marks


def _merged(window: Window, steps: Sequence[Step], *, by_quality: bool = False) -> Iterable[tuple[Step, int]]:
    """Spans, with neighbours of the same value (or of the same quality and reason) as one."""

    def same(a: Step, b: Step) -> bool:
        if by_quality:
            return (a.quality, a.reason) == (b.quality, b.reason)
        return (a.value, a.quality) == (b.value, b.quality)

    held: tuple[Step, int] | None = None
    for step, end_ns in _spans(window, steps):
        if held is not None and same(held[0], step):
            held = held[0], end_ns
            continue
        if held is not None:
            yield held
        held = step, end_ns
    if held is not None:
        yield held


def _spans(window: Window, steps: Sequence[Step]) -> Iterable[tuple[Step, int]]:
    for number, step in enumerate(steps):
        end_ns = steps[number + 1].t_ns if number + 1 < len(steps) else window.end_ns
        if end_ns > window.start_ns or number + 1 == len(steps):
            yield step, end_ns


# -- axis and failure -----------------------------------------------------------------------------------------------


def _time_axis(axis: _Axis, window: Window, height: float) -> list[Markup]:
    wanted = window.span_ns / 8
    magnitude = 10 ** math.floor(math.log10(wanted))
    step = int(next(m * magnitude for m in (1, 2, 5, 10) if m * magnitude >= wanted))
    first = -(-window.start_ns // step) * step
    digits = max(0, 9 - int(math.log10(step) + 1e-9))
    marks = []
    for t_ns in range(first, window.end_ns + 1, max(1, step)):
        x = axis.x(t_ns)
        marks.append(el("line", cls="grid", x1=x, x2=x, y1=26.0, y2=height - 4))
        marks.append(el("text", f"{t_ns / SECOND_NS:.{digits}f} s", cls="tick", x=x, y=16.0))
    return marks


def _failure(axis: _Axis, window: Window, height: float) -> list[Markup]:
    x, check = axis.x(window.at_ns), window.check
    marks = []
    if check.since_ns is not None and check.since_ns < window.at_ns:
        x0 = axis.x(check.since_ns)
        marks.append(el("rect", cls="watched", x=x0, y=22.0, width=max(1.0, x - x0), height=height - 26))
    marks.append(el("line", cls="failed", x1=x, x2=x, y1=20.0, y2=height - 4))
    marks.append(el("path", cls="failedtip", d=f"M{x - 5:.1f} 18h10l-5 8z"))
    return marks


def _fitted(said: str, x1: float, x2: float, y: float, cls: str, *, cut: bool = False) -> list[Markup]:
    """Text inside a box, if there is room for it, or for the beginning of it."""
    room = int((x2 - x1 - 8) / _CHAR)
    if len(said) > room and (not cut or room < 3):
        return []
    shown = said if len(said) <= room else said[: room - 1] + "…"
    return [el("text", shown, cls=cls, x=max(x1, LEFT) + 5, y=y)]


def _quality(step: Step) -> str:
    return _QUALITIES.get(step.quality, "bad")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _number(value: float) -> str:
    return show_value(value, 5)


def _unit(system: System | None, name: str) -> str:
    device, _, tag = name.partition(".")
    config = system.devices.get(device) if system else None
    return config.profile.tags[tag].unit if config and tag in config.profile.tags else ""


def _seconds(t_ns: int) -> str:
    return f"{t_ns / SECOND_NS:.4f} s"
