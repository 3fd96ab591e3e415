"""A timing diagram of a window as inline SVG: faults, buses, program states and values under one time axis.

Each lane is a block of a fixed height. Text that does not fit is in the title of its mark (shown when the mouse points
at it) and in the table of frames below. Colours are variables of the page, so that light, dark and print each have
their own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

from fieldtwin.capture.decoding.exchange import DecodedExchange
from fieldtwin.capture.decoding.tags import show_value
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.reports.markup import Markup, el
from fieldtwin.reports.run.axis import CHAR, LEFT, RIGHT, WIDTH, Lane, TimeAxis, fitted, label, seconds
from fieldtwin.reports.run.value_lanes import value_lane
from fieldtwin.reports.run.window import FaultBar, PlotStep, Window
from fieldtwin.twin.site.system import System

MOST_TAGS = 10
MOST_STATES = 6
MOST_BUSES = 6
MOST_FAULTS = 8
MOST_MARKS = 250
"""Largest number of marks in a lane; more would make it solid black."""


def timing_diagram(window: Window, system: System | None, title: str) -> Markup:
    """Return the drawing."""
    axis = TimeAxis(window.start_ns, window.span_ns, window.at_ns)
    lanes: list[Lane] = []
    lanes += [_fault_lane(axis, bar) for bar in window.faults[:MOST_FAULTS]]
    lanes += [_wire_lane(axis, window, bus, system) for bus in _buses(window)]
    lanes += _scan_lane(axis, window, system)
    for names, steps in ((_chosen(window, window.states), window.states), (_chosen(window, window.tags), window.tags)):
        for name in names:
            tag = _tag(system, name) if steps is window.tags else None
            words = dict(tag.values) if tag else {}
            lanes.append(value_lane(axis, window, name, steps[name], tag.unit if tag else "", words))
    unseen = [n for n in window.check.names if "." in n and n not in window.tags and n not in window.states]
    never = el("text", "never published", cls="sub", x=LEFT + 5, y=15.0)
    lanes += [Lane(22.0, [*label(n), never], ()) for n in unseen]
    return stacked(axis, lanes, title, lambda height: _failure(axis, window, height))


def stacked(axis: TimeAxis, lanes: Sequence[Lane], title: str, over: Callable[[float], list[Markup]]) -> Markup:
    """Return a drawing of lanes below each other under one time axis. `over` gets its height and returns the marks over it."""
    times = _times(axis)
    top, parts = 30.0, []
    for number, lane in enumerate(lanes):
        stripe = el("rect", cls=f"stripe{number % 2}", x=0.0, y=0.0, width=WIDTH, height=lane.height)
        grid = _grid(axis, times, lane)
        parts.append(el("g", stripe, grid, lane.marks, transform=f"translate(0 {top:.0f})"))
        top += lane.height + 2
    height = top + 6
    return el(
        "svg",
        el("title", title),
        parts,
        _ticks(axis, times),
        over(height),
        cls="timing", viewBox=f"0 0 {WIDTH:.0f} {height:.0f}", role="img", xmlns="http://www.w3.org/2000/svg",
    )  # fmt: skip


# -- which lanes ------------------------------------------------------------------------------------------------------


def _buses(window: Window) -> list[str]:
    named = {name.rpartition(".")[0] for name in window.check.names}
    buses = dict.fromkeys(e.bus for e in window.exchanges)
    about = {e.bus for e in window.exchanges if e.device in named or e.bus in named}
    return sorted(buses, key=lambda b: b not in about)[:MOST_BUSES]


def _chosen(window: Window, lanes: dict[str, list[PlotStep]]) -> list[str]:
    """Return the lanes to draw: first those that the check names, then those of the same devices, then others. Within each group,
    words come before numbers, and lanes with more changes first. A lane that the check does not name and that never changes is
    left out, except for a state in words.
    """
    names = window.check.names
    devices = {name.rpartition(".")[0] for name in names}

    def rank(name: str) -> tuple[int, bool, int]:
        steps = lanes[name]
        about = 0 if name in names else 1 if name.rpartition(".")[0] in devices else 2
        return about, not _in_words(steps), -len({(str(s.value), s.quality) for s in steps})

    def tells(name: str) -> bool:
        steps = lanes[name]
        moved = len({(str(s.value), s.quality) for s in steps}) > 1 or steps[0].quality not in ("", "good")
        return name in names or moved or (_in_words(steps) and not steps[0].quality)

    most = MOST_STATES if lanes is window.states else MOST_TAGS
    return sorted(filter(tells, lanes), key=rank)[:most]


def _in_words(steps: list[PlotStep]) -> bool:
    return any(isinstance(s.value, str) for s in steps)


def _tag(system: System | None, name: str) -> Tag | None:
    device, _, tag = name.rpartition(".")
    config = system.devices.get(device) if system else None
    return config.profile.tags.get(tag) if config else None


# -- lanes --------------------------------------------------------------------------------------------------------------


def _fault_lane(axis: TimeAxis, bar: FaultBar) -> Lane:
    x1, x2 = axis.x(bar.on_ns), axis.x(bar.off_ns) if bar.off_ns is not None else WIDTH - RIGHT
    said = f"{bar.name} {bar.target}".strip()
    off = f"to {seconds(bar.off_ns)}" if bar.off_ns is not None else "and not removed"
    box = el(
        "rect", el("title", f"fault {bar.id}: {said}, from {seconds(bar.on_ns)} {off}"), cls="fault",
        x=x1, y=3.0, width=max(2.0, x2 - x1), height=16.0, rx=2,
    )  # fmt: skip
    return Lane(22.0, [*label(f"fault {bar.id}"), box, *fitted(axis, said, x1, x2, 15.0, "faulttext")])


def _wire_lane(axis: TimeAxis, window: Window, bus: str, system: System | None) -> Lane:
    """Return the lane of a bus.

    A request is a box as long as the wait for its answer, a message is a tick; text is added where there is room.
    """
    config = system.buses.get(bus) if system else None
    timeout_ns = round((config.timeout_s if config else 1.0) * NS_PER_S)
    exchanges = sorted((e for e in window.exchanges if e.bus == bus), key=lambda e: e.t_ns)
    marks = label(bus, config.endpoint.scheme.upper() if config else "")
    rows = sorted({_row(e) for e in exchanges})
    words: list[tuple[int, float, float, str, str]] = []
    step = {ok: max(1, math.ceil(sum(e.ok is ok for e in exchanges) / MOST_MARKS)) for ok in (True, False)}
    for number, exchange in enumerate(exchanges):
        if number % step[exchange.ok]:
            continue
        kind, top = _kind(exchange), 18.0 + 32 * rows.index(_row(exchange))
        x1, waited = axis.x(exchange.t_ns), exchange.latency_ns
        if kind == "lost":
            following = exchanges[number + 1].t_ns if number + 1 < len(exchanges) else exchange.t_ns + timeout_ns
            waited = min(timeout_ns, max(0, following - exchange.t_ns))
        x2 = max(x1 + 2.2, axis.x(exchange.t_ns + (waited or 0)))
        size = {"x": x1, "y": top, "width": x2 - x1, "height": 12.0, "rx": 1}
        marks.append(el("rect", el("title", _tooltip(exchange)), cls=f"x {kind}", **size))
        words.append((_RANK.get(kind, 0), top - 4, x1, _short(exchange), kind))
    thinned = max(step.values()) > 1 or bus in window.thinned
    if thinned:
        marks.append(el("text", "thinned: too many", cls="sub", x=8.0, y=41.0))
    height = max(36.0, 4.0 + 32 * len(rows)) + (10 if thinned else 0)
    grid = [(17.0 + 32 * row, min(32.0 + 32 * row, height)) for row in range(len(rows))]
    return Lane(height, marks + _words(axis, words), grid)


_RANK = {"message": 3, "asked": 2, "wrote": 1}
"""Priority of the labels if there is not room for all; a lower number comes first. All other kinds (errors) have 0."""


def _words(axis: TimeAxis, words: list[tuple[int, float, float, str, str]]) -> list[Markup]:
    """Return as many labels as fit without overlap. Each of `words` is rank, y, x, text, kind.

    A label that would cross the line of the verdict ends before it.
    """
    line = axis.x(axis.at_ns) if axis.at_ns is not None else WIDTH
    placed: dict[float, list[tuple[float, float]]] = {}
    marks = []
    for _, y, x1, said, kind in sorted(words):
        width = len(said) * CHAR + 8
        left = line - width if x1 < line < x1 + width else x1
        taken = placed.setdefault(y, [])
        if left >= LEFT and left + width < WIDTH and all(left + width <= a or left >= b for a, b in taken):
            taken.append((left, left + width))
            marks.append(el("text", said, cls=f"words {kind}", x=left, y=y))
    return marks


def _row(exchange: DecodedExchange) -> int:
    """Return the row of an exchange in its lane: 0 (upper) for a request with its reply or timeout, 1 for a message."""
    return 0 if exchange.latency_ns is not None or exchange.problem == "no reply" else 1


def _scan_lane(axis: TimeAxis, window: Window, system: System | None) -> list[Lane]:
    """Return the lane of the PLC scans in which a state changed, each with its changes; [] if no state changed."""
    changed: dict[int, list[str]] = {}
    for name, steps in window.states.items():
        for step in steps:
            if step.t_ns >= window.start_ns:
                changed.setdefault(step.t_ns, []).append(f"{name} = {show_value(step.value)}")
    if not changed:
        return []
    every = f"every {system.plc.cycle_ms:g} ms" if system else ""
    marks = label("scans with changes", every)
    for t_ns in sorted(changed)[-MOST_MARKS:]:
        said = "\n".join([seconds(t_ns), *changed[t_ns][:8]])
        marks.append(el("rect", el("title", said), cls="x scan", x=axis.x(t_ns), y=6.0, width=2.2, height=16.0))
    return [Lane(34.0, marks)]


def _kind(exchange: DecodedExchange) -> str:
    if exchange.ok:
        return "message" if exchange.latency_ns is None else "asked" if not exchange.writes() else "wrote"
    return {"no reply": "lost", "exception": "refused", "abort": "refused"}.get(exchange.problem, "broken")


def _short(exchange: DecodedExchange) -> str:
    """Return a short description of an exchange: the service and its address, or the problem."""
    if exchange.problem == "exception" and exchange.exception is not None:
        return f"exception {exchange.exception:02X}"
    if exchange.problem == "abort" and exchange.abort is not None:
        return f"abort {exchange.abort:08X}h"
    if exchange.problem:
        return f"{exchange.device or f'unit {exchange.unit}'}: {exchange.problem}"
    name = exchange.device or (f"unit {exchange.unit}" if exchange.unit else "")
    text = exchange.text.removeprefix(f"{name}: ")
    verb = {"read holding registers": "read", "read input registers": "read", "write registers": "write"}
    for long, short in verb.items():
        if text.startswith(long):
            where = exchange.spans[0] if exchange.spans else ""
            text = f"{short} {str(where).partition(' ')[0]}"
    said = f"{name} {text}".strip()
    return said if len(said) <= 46 else said[:45] + "…"


def _tooltip(exchange: DecodedExchange) -> str:
    took = f", {exchange.latency_ns / 1e6:.3g} ms" if exchange.latency_ns is not None else ""
    answer = f"\n{exchange.reply_text}{took}" if exchange.reply_text else ""
    return f"{seconds(exchange.t_ns)}  {exchange.text}{answer}"[:240]


# -- axis and failure -----------------------------------------------------------------------------------------------


def _times(axis: TimeAxis) -> dict[int, str]:
    """Return the round times of the axis, each with its text, about eight."""
    wanted = axis.span_ns / 8
    magnitude = 10 ** math.floor(math.log10(wanted))
    step = int(next(m * magnitude for m in (1, 2, 5, 10) if m * magnitude >= wanted))
    first = -(-axis.start_ns // step) * step
    digits = max(0, 9 - int(math.log10(step) + 1e-9))
    return {
        t_ns: f"{t_ns / NS_PER_S:.{digits}f} s" for t_ns in range(first, axis.start_ns + axis.span_ns + 1, max(1, step))
    }


def _grid(axis: TimeAxis, times: Iterable[int], lane: Lane) -> list[Markup]:
    """Return the lines of round times in a lane, below its marks."""
    stretches = [(-2.0, lane.height)] if lane.grid is None else lane.grid
    return [el("line", cls="grid", x1=axis.x(t), x2=axis.x(t), y1=y1, y2=y2) for t in times for y1, y2 in stretches]


def _ticks(axis: TimeAxis, times: Mapping[int, str]) -> list[Markup]:
    return [el("text", said, cls="tick", x=axis.x(t_ns), y=16.0) for t_ns, said in times.items()]


def _failure(axis: TimeAxis, window: Window, height: float) -> list[Markup]:
    x, check = axis.x(window.at_ns), window.check
    marks = []
    if check.since_ns is not None and check.since_ns < window.at_ns:
        x0 = axis.x(check.since_ns)
        marks.append(el("rect", cls="watched", x=x0, y=22.0, width=max(1.0, x - x0), height=height - 26))
    marks.append(el("line", cls="failed", x1=x, x2=x, y1=20.0, y2=height - 4))
    marks.append(el("path", cls="failedtip", d=f"M{x - 5:.1f} 18h10l-5 8z"))
    return marks
