"""Lanes of a timing diagram for values: numbers as a stepped line on a background that shows their quality, words as boxes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

from fieldtwin.capture.decoding.tags import show_value
from fieldtwin.reports.markup import Markup, el
from fieldtwin.reports.run.axis import Lane, TimeAxis, fitted, label, seconds
from fieldtwin.reports.run.window import PlotStep, Window, thin_steps

MOST_POINTS = 300
"""Largest number of changes that are drawn in a lane."""
_QUALITIES = {"": "good", "good": "good", "simulated": "good", "substituted": "doubt", "uncertain": "doubt"}
_FEW = 3
"""A state with at most this many different values is drawn as words, because a line would show nothing useful."""


def value_lane(
    axis: TimeAxis,
    window: Window,
    name: str,
    steps: list[PlotStep],
    unit: str = "",
    words: Mapping[Any, str] | None = None,
) -> Lane:
    """Return the lane of a tag or variable. `words` are the names of values; a state with more values is drawn as a number."""
    drawn = _thinned(steps)
    numbers = [s.value for s in drawn if _is_number(s.value)]
    is_state = not any(s.quality for s in drawn)
    thinned = name in window.thinned or len(drawn) < len(steps)
    if words or not numbers or (is_state and len(set(numbers)) <= _FEW):
        boxes = _boxes(axis, window, drawn, words or {}, "state" if is_state else "value")
        return Lane(26.0, [*label(name), *boxes])
    return _line(axis, window, name, drawn, unit, thinned=thinned)


def _line(axis: TimeAxis, window: Window, name: str, steps: Sequence[PlotStep], unit: str, *, thinned: bool) -> Lane:
    numbers = [s.value for s in steps if _is_number(s.value)]
    low, high = min(numbers), max(numbers)
    bad = [span for span in _merged(window, steps, by_quality=True) if _quality(span[0]) != "good"]
    top, room = (20.0 if bad else 8.0), 30.0
    height = top + room + 6

    def y(value: float) -> float:
        return top + room * (0.5 if high == low else 1 - (value - low) / (high - low))

    bounds = f"{_number(low)} … {_number(high)} {unit}" if high != low else f"{_number(low)} {unit}"
    marks = [*label(name, bounds), *([el("text", "thinned", cls="sub", x=8.0, y=40.0)] if thinned else [])]
    lines: list[Markup] = []
    paths: dict[str, list[str]] = {}
    for step, end_ns in _spans(window, steps):
        if _is_number(step.value):
            x1, x2 = axis.x(step.t_ns), axis.x(end_ns)
            paths.setdefault(_quality(step), []).append(f"M{x1:.1f} {y(step.value):.1f}H{max(x2, x1 + 1):.1f}")
    for step, end_ns in bad:
        x1, x2, kind = axis.x(step.t_ns), axis.x(end_ns), _quality(step)
        why = f"{step.quality}" + (f": {step.reason}" if step.reason not in ("", "none") else "")
        size = {"x": x1, "y": 3.0, "width": max(1.0, x2 - x1), "height": height - 6}
        marks.append(el("rect", el("title", f"{seconds(step.t_ns)}  {name} {why}"), cls=f"q {kind}", **size))
        lines += fitted(axis, why, x1, x2, 14.0, f"qtext {kind}", cut=True)
    lines += [el("path", cls=f"line {kind}", d="".join(d)) for kind, d in paths.items()]
    lines.append(_risers(axis, steps, y))
    return Lane(height, marks + lines)


def _thinned(steps: list[PlotStep]) -> list[PlotStep]:
    while len(steps) > MOST_POINTS:
        steps = thin_steps(steps)
    return steps


def _risers(axis: TimeAxis, steps: Sequence[PlotStep], y: object) -> Markup:
    """Return the vertical lines between two consecutive values."""
    assert callable(y)
    parts = [
        f"M{axis.x(b.t_ns):.1f} {y(a.value):.1f}V{y(b.value):.1f}"
        for a, b in pairwise(steps)
        if _is_number(a.value) and _is_number(b.value) and a.value != b.value
    ]
    return el("path", cls="riser", d="".join(parts)) if parts else Markup("")


def _boxes(
    axis: TimeAxis, window: Window, steps: Sequence[PlotStep], words: Mapping[Any, str], cls: str
) -> list[Markup]:
    """Return a box for each value from its start to its end, with slanted edges, as logic analysers draw them."""
    marks = []
    for step, end_ns in _merged(window, steps):
        x1, x2, top = axis.x(step.t_ns), axis.x(end_ns), 4.0
        quality = _quality(step)
        why = "" if quality == "good" else f"{step.quality}: {step.reason}"
        said = words.get(step.value) if isinstance(step.value, int) else None
        said = said or (step.value if isinstance(step.value, str) else show_value(step.value)) or "empty"
        said = why if why and step.value is None else said
        slant = min(3.0, (x2 - x1) / 2)
        edge, back = f"l{slant:.1f} -9H{x2 - slant:.1f}", f"l{slant:.1f} 9l{-slant:.1f} 9H{x1 + slant:.1f}z"
        title = el("title", f"{seconds(step.t_ns)}  {said} {why}")
        marks.append(el("path", title, cls=f"{cls} {quality}", d=f"M{x1:.1f} {top + 9:.1f}{edge}{back}"))
        marks += fitted(axis, said, x1 + 2, x2, top + 13, f"{cls}text", cut=True)
    return marks


def _merged(window: Window, steps: Sequence[PlotStep], *, by_quality: bool = False) -> Iterable[tuple[PlotStep, int]]:
    """Yield spans, with neighbours of the same value (or of the same quality and reason) merged into one."""

    def same(a: PlotStep, b: PlotStep) -> bool:
        if by_quality:
            return (a.quality, a.reason) == (b.quality, b.reason)
        return (a.value, a.quality) == (b.value, b.quality)

    held: tuple[PlotStep, int] | None = None
    for step, end_ns in _spans(window, steps):
        if held is not None and same(held[0], step):
            held = held[0], end_ns
            continue
        if held is not None:
            yield held
        held = step, end_ns
    if held is not None:
        yield held


def _spans(window: Window, steps: Sequence[PlotStep]) -> Iterable[tuple[PlotStep, int]]:
    for number, step in enumerate(steps):
        end_ns = steps[number + 1].t_ns if number + 1 < len(steps) else window.end_ns
        if end_ns > window.start_ns or number + 1 == len(steps):
            yield step, end_ns


def _quality(step: PlotStep) -> str:
    return _QUALITIES.get(step.quality, "bad")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _number(value: float) -> str:
    return show_value(value, 5)
