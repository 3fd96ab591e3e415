"""Draws a state machine as SVG, without a network, a font or a layout program.

States are placed on an ellipse in the order of their codes, with the initial state on top and a dot before it; each transition
is an arrow with its guard. Transitions from any state are drawn from each state. This module reads and writes no file.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from math import atan2, cos, hypot, pi, sin
from typing import Protocol

from fieldtwin.plc.states import Transition

_CHAR = 7.2
"""Width of a character of the 12 px monospace font, in px."""
_BOX_H = 40.0
_LINE_H = 16.0
_MARGIN = 60.0
_LABEL_AT = (0.36, 0.5, 0.26, 0.62, 0.72, 0.18)
"""How far along its arrow a label may be placed, the best first: nearer to the source, because arrows meet in the
middle."""
_STYLE = """
  svg { font: 12px ui-monospace, Menlo, Consolas, monospace; fill: none }
  .ground { fill: #fff }
  .box { fill: #eef3fb; stroke: #2b5597; stroke-width: 1.5 } .now { fill: #ffe9b8 }
  .name { fill: #14284a; text-anchor: middle; font-weight: 600 }
  .arrow { fill: none; stroke: #5b6b85; stroke-width: 1.3 } .tip { fill: #5b6b85 }
  .label { fill: #333; text-anchor: middle } .paper { fill: #fff; opacity: .88 } .dot { fill: #14284a }
"""


class Drawable(Protocol):
    """A state machine that can be drawn: a `StateTable`, or the `StateDiagram` of a program in Structured Text."""

    @property
    def states(self) -> tuple[str, ...]: ...

    @property
    def initial(self) -> str: ...

    def leaving(self, state: str) -> list[Transition]:
        """Return the transitions that begin in `state`."""
        ...


@dataclass(frozen=True, slots=True)
class _Box:
    x: float
    y: float
    width: float

    def edge(self, angle: float) -> tuple[float, float]:
        """Return the point at which a line from the middle of the box at `angle` leaves it."""
        dx, dy = cos(angle), sin(angle)
        across = self.width / 2 / abs(dx) if dx else float("inf")
        up = _BOX_H / 2 / abs(dy) if dy else float("inf")
        length = min(across, up) + 2
        return self.x + dx * length, self.y + dy * length


class _Labels:
    """The placement of texts, so that, if there is enough room, they hide neither a state nor each other."""

    def __init__(self, boxes: Iterable[_Box]) -> None:
        self._taken = [(b.x - b.width / 2, b.y - _BOX_H / 2, b.x + b.width / 2, b.y + _BOX_H / 2) for b in boxes]
        self.drawn: list[str] = []

    def place(self, spots: Sequence[tuple[float, float]], lines: Sequence[str]) -> None:
        """Place `lines` at the first of `spots` where they hide nothing, or where they hide least.

        A spot is the middle of the text.
        """
        if not lines:
            return
        width, height = max(len(line) for line in lines) * _CHAR + 8, len(lines) * _LINE_H + 2
        frames = [(x - width / 2, y - height / 2, x + width / 2, y + height / 2) for x, y in spots]
        frame = min(frames, key=lambda f: sum(_overlap(f, other) for other in self._taken))
        self._taken.append(frame)
        left, top = frame[:2]
        self.drawn.append(
            f'<rect class="paper" x="{left:.1f}" y="{top:.1f}" width="{width:.1f}" height="{height:.1f}" rx="3"/>'
        )
        for n, line in enumerate(lines):
            y = top + 13 + n * _LINE_H
            self.drawn.append(f'<text class="label" x="{left + width / 2:.1f}" y="{y:.1f}">{escape(line)}</text>')


def _overlap(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))


def svg(table: Drawable, title: str = "", current: str = "") -> str:
    """Return the diagram of `table` as SVG text, with the state `current` highlighted."""
    arrows = _arrows(table)
    longest = max((len(line) for *_, lines in arrows for line in lines), default=0)
    boxes = _places(table, longest)
    width = max(b.x + b.width / 2 for b in boxes.values()) + _MARGIN + longest * _CHAR / 2
    height = max(b.y for b in boxes.values()) + _BOX_H + _MARGIN
    middle = (sum(b.x for b in boxes.values()) / len(boxes), sum(b.y for b in boxes.values()) / len(boxes))
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" '
        f'height="{height:.0f}" role="img"><title>{escape(title or "state machine")}</title><style>{_STYLE}</style>'
        '<rect class="ground" width="100%" height="100%"/>'
    ]
    labels = _Labels(boxes.values())
    for source, target, lines in arrows:
        both = any(s == target and t == source for s, t, _ in arrows)
        parts.append(_arrow(boxes[source], boxes[target], source == target, both, middle, lines, labels))
    for name, box in boxes.items():
        style = "box now" if name == current else "box"
        left, top = box.x - box.width / 2, box.y - _BOX_H / 2
        parts.append(
            f'<rect class="{style}" x="{left:.1f}" y="{top:.1f}" width="{box.width:.1f}" height="{_BOX_H}" rx="9"/>'
            f'<text class="name" x="{box.x:.1f}" y="{box.y + 4:.1f}">{escape(name)}</text>'
        )
    first = boxes[table.initial]
    top = first.y - _BOX_H / 2
    parts.append(f'<circle class="dot" cx="{first.x:.1f}" cy="{top - 26:.1f}" r="5"/>')
    parts.append(
        f'<path class="arrow" d="M{first.x:.1f},{top - 21:.1f} V{top - 6:.1f}"/>{_tip(first.x, top - 1, pi / 2)}'
    )
    return "\n".join([*parts, *labels.drawn, "</svg>", ""])


def _arrows(table: Drawable) -> list[tuple[str, str, list[str]]]:
    """Return the arrows as (source, target, labels).

    Transitions between the same two states share an arrow, with a label each.
    """
    found: dict[tuple[str, str], list[str]] = {}
    for state in table.states:
        for transition in table.leaving(state):
            found.setdefault((state, transition.target), []).append(transition.label)
    return [(s, t, list(dict.fromkeys(label for label in labels if label))) for (s, t), labels in found.items()]


def _places(table: Drawable, longest: int) -> dict[str, _Box]:
    names = [table.initial, *(s for s in table.states if s != table.initial)]
    widths = {n: max(70.0, len(n) * _CHAR + 24) for n in names}
    around = max(longest * _CHAR + 60, max(widths.values()) + 40) * len(names) / (2 * pi) * 1.3
    rx, ry = max(170.0, around), max(150.0, around * 0.66)
    if len(names) == 1:
        rx = ry = 0.0
    cx = rx + max(widths.values()) / 2 + _MARGIN + longest * _CHAR / 2
    cy = ry + _BOX_H + _MARGIN
    return {
        name: _Box(cx + rx * sin(2 * pi * n / len(names)), cy - ry * cos(2 * pi * n / len(names)), widths[name])
        for n, name in enumerate(names)
    }


def _arrow(
    a: _Box, b: _Box, loop: bool, both: bool, middle: tuple[float, float], lines: list[str], labels: _Labels
) -> str:
    if loop:
        outward = atan2(a.y - middle[1], a.x - middle[0]) if (a.x, a.y) != middle else 0.0
        x1, y1 = a.edge(outward - 0.5)
        x2, y2 = a.edge(outward + 0.5)
        px, py = a.x + cos(outward) * 110, a.y + sin(outward) * 90
        bend = f"C{px:.1f},{py:.1f} {px:.1f},{py:.1f} {x2:.1f},{y2:.1f}"
        labels.place([(a.x + cos(outward) * far, a.y + sin(outward) * far * 0.85) for far in (92, 110, 128)], lines)
        return f'<path class="arrow" d="M{x1:.1f},{y1:.1f} {bend}"/>{_tip(x2, y2, atan2(y2 - py, x2 - px))}'
    dx, dy = b.x - a.x, b.y - a.y
    length = hypot(dx, dy)
    sway = 34.0 if both else 0.0  # two transitions in reverse directions are two arrows, and each bends to its right
    px, py = (a.x + b.x) / 2 - dy / length * sway * 2, (a.y + b.y) / 2 + dx / length * sway * 2
    x1, y1 = a.edge(atan2(py - a.y, px - a.x))
    x2, y2 = b.edge(atan2(py - b.y, px - b.x))
    labels.place([(_bezier(x1, px, x2, at), _bezier(y1, py, y2, at)) for at in _LABEL_AT], lines)
    tip = _tip(x2, y2, atan2(y2 - py, x2 - px))
    return f'<path class="arrow" d="M{x1:.1f},{y1:.1f} Q{px:.1f},{py:.1f} {x2:.1f},{y2:.1f}"/>{tip}'


def _bezier(start: float, control: float, end: float, at: float) -> float:
    """Return a coordinate of a quadratic curve at the position `at`, 0 to 1."""
    return (1 - at) ** 2 * start + 2 * at * (1 - at) * control + at**2 * end


def _tip(x: float, y: float, angle: float) -> str:
    points = [(x, y)] + [(x - 9 * cos(angle + s * 0.4), y - 9 * sin(angle + s * 0.4)) for s in (-1, 1)]
    return f'<path class="tip" d="M{" L".join(f"{px:.1f},{py:.1f}" for px, py in points)} Z"/>'
