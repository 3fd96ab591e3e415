"""The charts of a campaign's report as inline SVG. Colours are variables of the page, so that light, dark and print each have
their own.
"""

from __future__ import annotations

from collections.abc import Sequence

from fieldtwin.reports.campaign.workers import Timeline
from fieldtwin.reports.markup import Markup, el
from fieldtwin.reports.pages import duration

WIDTH, HEIGHT = 900.0, 190.0
LEFT, RIGHT, TOP, BOTTOM = 56.0, 14.0, 12.0, 28.0
TICKS = 4
_FAILED_AT_LEAST = 4.0
"""Smallest height of a bar of failed runs in px, so that one failure among thousands of runs is visible."""


def runs_chart(timeline: Timeline) -> Markup:
    """Return a bar chart of the runs that ended in each interval of wall time."""
    marks: list[Markup] = []
    most = _round_up(timeline.most)
    step = (WIDTH - LEFT - RIGHT) / len(timeline.passed)
    room = HEIGHT - TOP - BOTTOM
    for number, (passed, failed) in enumerate(zip(timeline.passed, timeline.failed, strict=True)):
        x, base = LEFT + number * step, HEIGHT - BOTTOM
        at = duration(number * timeline.bin_s)
        for count, kind in ((failed, "failed"), (passed, "passed")):
            if not count:
                continue
            height = max(count / most * room, _FAILED_AT_LEAST if kind == "failed" else 1.0)
            title = el("title", f"{count} {kind}, {at} after the start")
            marks.append(
                el("rect", title, cls=f"bar-{kind}", x=x + 0.5, y=base - height, width=step - 1, height=height)
            )
            base -= height
    labels = [duration(n * (timeline.end_s - timeline.start_s) / TICKS) for n in range(TICKS + 1)]
    return _chart("runs that ended over wall time", most, labels, marks)


def curve_chart(title: str, points: Sequence[tuple[float, int]]) -> Markup:
    """Return a step curve through `points`, each a virtual time in hours (rising) and a count, which begins at (0, 0)."""
    end, most = max(points[-1][0], 1e-9), _round_up(max(y for _, y in points))
    across, room = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM
    words, last = [f"M{LEFT:.1f} {HEIGHT - BOTTOM:.1f}"], ""
    for x, y in points:
        word = f"H{LEFT + x / end * across:.1f}V{HEIGHT - BOTTOM - y / most * room:.1f}"
        if word != last:
            words.append(word)
        last = word
    labels = [_hours(n * end / TICKS) if end >= 1 else duration(n * end / TICKS * 3600) for n in range(TICKS + 1)]
    return _chart(title, most, labels, [el("path", cls="curve", d="".join(words))])


def _chart(title: str, most: int, labels: Sequence[str], marks: Sequence[Markup]) -> Markup:
    """Return a chart from 0 to `most`, with labels at equal distances below it."""
    parts: list[Markup] = []
    rows = 2 if most < TICKS else TICKS
    for n in range(rows + 1):
        y = HEIGHT - BOTTOM - n * (HEIGHT - TOP - BOTTOM) / rows
        parts.append(el("path", cls="rule", d=f"M{LEFT:.1f} {y:.1f}H{WIDTH - RIGHT:.1f}"))
        value = most * n / rows
        parts.append(el("text", f"{value:,.0f}" if value == int(value) else "", cls="y", x=LEFT - 8, y=y + 4))
    for number, said in enumerate(labels):
        x = LEFT + number * (WIDTH - LEFT - RIGHT) / (len(labels) - 1)
        anchor = "start" if number == 0 else "end" if number == len(labels) - 1 else "middle"
        parts.append(el("text", said, x=x, y=HEIGHT - 8, text_anchor=anchor))
    return el(
        "svg", el("title", title), parts, marks,
        cls="chart", viewBox=f"0 0 {WIDTH:.0f} {HEIGHT:.0f}", role="img", xmlns="http://www.w3.org/2000/svg",
    )  # fmt: skip


def _hours(hours: float) -> str:
    return f"{hours:,.0f} h" if hours >= 100 else f"{hours:.3g} h"


def _round_up(count: int) -> int:
    """Return the next number of the form 1, 2, 4 or 8 times a power of ten, as the upper end of an axis."""
    power = 1
    while True:
        for step in (1, 2, 4, 8):
            if step * power >= count:
                return step * power
        power *= 10
