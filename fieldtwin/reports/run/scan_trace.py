"""A trace of variables as a drawing of trends (SVG), and as a page with the drawing and the extremes of each variable (HTML)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.reports.drawing.themes import themed
from fieldtwin.reports.markup import Markup, el
from fieldtwin.reports.pages import fill
from fieldtwin.reports.run.axis import TimeAxis
from fieldtwin.reports.run.diagram import stacked
from fieldtwin.reports.run.value_lanes import value_lane
from fieldtwin.reports.run.window import PlotStep, Window
from fieldtwin.results.model import CheckResult, Verdict
from fieldtwin.results.scan_trace import ScanTrace

_LIGHT = {
    "ink": "#1c2430", "dim": "#5c6878", "rule": "#dde3ea", "soft": "#f4f6f9", "asked": "#2f6fd0", "state": "#e6eefb",
    "stateline": "#2b5597", "trigger": "#8a5a00",
}  # fmt: skip
_DARK = {
    "ink": "#e4e8ee", "dim": "#9aa6b5", "rule": "#2c343f", "soft": "#1a2028", "asked": "#5e9bff", "state": "#1c2c47",
    "stateline": "#7fa8e8", "trigger": "#e3b341",
}  # fmt: skip
_RULES = """
.timing { font-family: ui-monospace, monospace; font-size: 10.5px; } .timing text { fill: var(--ink) }
.timing .lane { font-weight: 600; font-size: 11px } .timing .sub { fill: var(--dim); font-size: 10px }
.timing .tick { fill: var(--dim); font-size: 10px; text-anchor: middle } .timing .stripe0 { fill: var(--soft) }
.timing .stripe1 { fill: none } .timing .grid { stroke: var(--rule) }
.timing .state { fill: var(--state); stroke: var(--stateline) }
.timing .line { fill: none; stroke: var(--asked); stroke-width: 1.8 }
.timing .trigger { stroke: var(--trigger); stroke-width: 1.6 }
.timing .riser { fill: none; stroke: var(--asked); stroke-width: 0.9 }
"""


def trace_svg(trace: ScanTrace, title: str) -> Markup:
    """Return the drawing: a lane for each variable, and a line at the scan of the trigger."""
    style = el("style", Markup(themed(_RULES, _LIGHT, _DARK)))
    return _drawing(trace, title, [style])


def trace_page(trace: ScanTrace, title: str) -> Markup:
    """Return a page with the drawing, and a table with the first, last, smallest and largest value of each variable."""
    rows = [(one.name, one.type, one.shown_unit, *_extremes(trace.column(n))) for n, one in enumerate(trace.columns)]
    return fill(
        "scan_trace.html.j2", title=title, drawing=trace_svg(trace, title), rows=rows, trace=trace,
        span_s=(trace.rows[-1].t_ns - trace.rows[0].t_ns) / 1e9 if trace.rows else 0.0,
    )  # fmt: skip


def _drawing(trace: ScanTrace, title: str, over: Sequence[Markup]) -> Markup:
    zero = trace.zero_ns
    start = trace.rows[0].t_ns - zero if trace.rows else 0
    end = trace.rows[-1].t_ns - zero if trace.rows else 1
    window = Window(CheckResult("", "", Verdict.PASSED), start, max(end, start + NS_PER_MS), start)
    axis = TimeAxis(start, window.span_ns)
    lanes = [
        value_lane(axis, window, one.name, _steps(trace, n, zero), one.shown_unit)
        for n, one in enumerate(trace.columns)
    ]

    def marks(height: float) -> list[Markup]:
        if trace.triggered is None:
            return list(over)
        x = axis.x(0)
        line = el("line", el("title", "trigger"), cls="trigger", x1=x, x2=x, y1=20.0, y2=height - 4)
        return [*over, line]

    return stacked(axis, lanes, title, marks)


def _steps(trace: ScanTrace, n: int, zero: int) -> list[PlotStep]:
    """Return the changes of a variable."""
    steps: list[PlotStep] = []
    for row in trace.rows:
        value: Any = trace.columns[n].shown(row.values[n])
        if isinstance(value, bool):
            value = str(value).upper()
        if not steps or steps[-1].value != value:
            steps.append(PlotStep(row.t_ns - zero, value))
    return steps or [PlotStep(0, None)]


def _extremes(values: Sequence[Any]) -> tuple[Any, Any, Any, Any]:
    """Return the first, last, smallest and largest value; the last two are empty without numbers."""
    numbers = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v)]
    least, most = (min(numbers), max(numbers)) if numbers else ("", "")
    return (*((values[0], values[-1]) if values else ("", "")), least, most)
