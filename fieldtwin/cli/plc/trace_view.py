"""A trace of variables on a terminal: a line for each variable, with a sparkline of its values."""

from __future__ import annotations

import math
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from fieldtwin.cli.plc.views import value_text
from fieldtwin.commissioning.access.watching import sparkline
from fieldtwin.console import stdout
from fieldtwin.results.scan_trace import ScanTrace

LEAST_LINE, OTHERS = 10, 58
"""The least width of a sparkline, and the width of all other columns, in characters."""


def trace_table(trace: ScanTrace, width: int, state: str = "") -> Group:
    """Return the variables with their last, smallest and largest values and their courses."""
    table = Table(box=None, pad_edge=False)
    for name in ("variable", "last", "min", "max", "unit", "trend"):
        right = name in ("last", "min", "max")
        table.add_column(name, justify="right" if right else "left", no_wrap=True, overflow="ellipsis")
    longest = max((len(one.name) for one in trace.columns), default=0)
    room = max(LEAST_LINE, width - max(OTHERS, 38 + longest))
    for n, one in enumerate(trace.columns):
        values = trace.column(n)
        numbers = [_number(value) for value in values]
        known = [v for v in numbers if v is not None]
        last = value_text(values[-1]) if values else "-"
        words = bool(values) and isinstance(values[-1], bool | str)
        extremes = ("", "") if words or not known else (value_text(min(known)), value_text(max(known)))
        cells = (one.name, last, *extremes, one.shown_unit, sparkline(_thinned(numbers, room)))
        table.add_row(*map(Text, cells))
    return Group(table, Text(_time(trace) + (f"; {state}" if state else ""), style="dim"))


def print_trace(trace: ScanTrace) -> None:
    stdout.print(trace_table(trace, stdout.width))


def _time(trace: ScanTrace) -> str:
    """Return the time that the trace covers in words."""
    times = trace.times_s()
    if not times:
        return "no scan yet"
    at = "the scan of the trigger is at 0 s" if trace.triggered is not None else "0 s is the first scan"
    return f"{len(times)} scans from {times[0]:.3f} s to {times[-1]:.3f} s; {at}"


def _number(value: Any) -> float | None:
    """Return a value as a number for a sparkline; None for one without, and for a text."""
    if isinstance(value, bool | int | float) and math.isfinite(value):
        return float(value)
    return None


def _thinned(values: list[float | None], room: int) -> list[float | None]:
    """Return at most `room` values: of each stretch the one that is farthest from that of the stretch before."""
    if len(values) <= room:
        return values
    found: list[float | None] = []
    for n in range(room):
        stretch = values[n * len(values) // room : (n + 1) * len(values) // room]
        known = [v for v in stretch if v is not None]
        before = found[-1] if found and found[-1] is not None else known[0] if known else 0.0
        found.append(max(known, key=lambda v: abs(v - before)) if known else None)
    return found
