"""The common parts of all lanes of a timing diagram: the time axis, labels on the left, and text where there is room
for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.reports.markup import Markup, el

WIDTH = 900.0
LEFT = 176.0
RIGHT = 14.0
CHAR = 6.3
"""Width of a character of the 10.5 px monospace face, in px."""


class Lane(NamedTuple):
    """A lane: its height, its marks, and where the grid of times is drawn in it (None: over the whole height)."""

    height: float
    marks: list[Markup]
    grid: Sequence[tuple[float, float]] | None = None
    """Stretches without text, from top to bottom, so that no line crosses a text that has no box around it."""


@dataclass
class TimeAxis:
    """Converts times to positions, in px from the left."""

    start_ns: int
    span_ns: int
    at_ns: int | None = None
    """Time of the verdict. No text may cross the line that is drawn there."""

    def x(self, t_ns: int) -> float:
        share = (t_ns - self.start_ns) / self.span_ns
        return LEFT + min(max(share, 0.0), 1.0) * (WIDTH - LEFT - RIGHT)


def label(name: str, below: str = "") -> list[Markup]:
    """Return a lane's label on the left, with the full name as its title, and a line below it."""
    most = int((LEFT - 14) / 6.9)  # lane names are bold
    shown = name if len(name) <= most else name[: most // 2 - 1] + "…" + name[-(most - most // 2) :]
    parts = [el("text", el("title", name), shown, cls="lane", x=8.0, y=15.0)]
    if below:
        parts.append(el("text", below[: most + 2], cls="sub", x=8.0, y=28.0))
    return parts


def fitted(axis: TimeAxis, said: str, x1: float, x2: float, y: float, cls: str, *, cut: bool = False) -> list[Markup]:
    """Return text inside a box if there is room for it, on one side of the line that marks the time of the verdict.

    With `cut`, a text that is too long is cut; if only a few characters would remain, its part before a colon is used.
    """
    x1 = max(x1, LEFT)
    sides = [(x1, x2)]
    if axis.at_ns is not None and x1 < (line := axis.x(axis.at_ns)) < x2:
        sides = sorted([(x1, line), (line, x2)], key=lambda side: (_room(*side) < len(said), side[0] - side[1]))
    start, room = sides[0][0], _room(*sides[0])
    if len(said) > room and cut:
        first = said.partition(":")[0]
        said = said[: room - 1] + "…" if room >= (3 if first == said else 6) else first
    return [el("text", said, cls=cls, x=start + 5, y=y)] if len(said) <= room else []


def _room(x1: float, x2: float) -> int:
    """Return the number of characters that fit between two positions in px."""
    return int((x2 - x1 - 8) / CHAR)


def seconds(t_ns: int) -> str:
    """Return a time of the run as text in seconds, for tooltips."""
    return f"{t_ns / NS_PER_S:.4f} s"
