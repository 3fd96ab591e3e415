"""The common parts of all lanes of a timing diagram: the time axis, labels on the left, and text where there is room
for it.
"""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.reports.markup import Markup, el

WIDTH = 900.0
LEFT = 176.0
RIGHT = 14.0
CHAR = 6.3
"""Width of a character of the 10.5 px monospace face, in px."""


@dataclass
class TimeAxis:
    """Converts times to positions, in px from the left."""

    start_ns: int
    span_ns: int

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


def fitted(said: str, x1: float, x2: float, y: float, cls: str, *, cut: bool = False) -> list[Markup]:
    """Return text inside a box if there is room for it; with `cut`, also the beginning of a longer text."""
    room = int((x2 - x1 - 8) / CHAR)
    if len(said) > room and (not cut or room < 3):
        return []
    shown = said if len(said) <= room else said[: room - 1] + "…"
    return [el("text", shown, cls=cls, x=max(x1, LEFT) + 5, y=y)]


def seconds(t_ns: int) -> str:
    """Return a time of the run, for titles."""
    return f"{t_ns / NS_PER_S:.4f} s"
