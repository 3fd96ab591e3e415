"""The parts of a drawing as SVG text: boxes, lines and texts in groups, without a font or a layout program.

Parts have classes and no colours, so that a page can give them its own. A drawing in a file has a style for light and for dark
displays. The width of a text is estimated from the monospace font that the style names.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from html import escape

CHAR = 7.3
"""The width of a character, in px."""
LINE = 15.0
"""The height of a line of text, in px."""
_MARGIN = 24.0
_LIGHT = {
    "ground": "#ffffff", "ink": "#14284a", "line": "#4a5a75", "box": "#eef3fb", "edge": "#2b5597", "soft": "#5b6b85",
    "field": "#ffffff",
}  # fmt: skip
_DARK = {
    "ground": "#12161f", "ink": "#e6ebf5", "line": "#93a3bf", "box": "#1d2739", "edge": "#7fa7e6", "soft": "#93a3bf",
    "field": "#171d29",
}  # fmt: skip
_RULES = """
.ground {{ fill: {ground} }}
.box {{ fill: {box}; stroke: {edge} }} .inner {{ stroke: {edge} }} .field {{ fill: {field}; stroke: {edge} }}
.line {{ stroke: {line} }} .bar {{ fill: {ink} }} .tip, .dot {{ fill: {line} }} .circle {{ fill: {ground}; stroke: {line} }}
text {{ fill: {ink} }} .soft {{ fill: {soft} }} .note {{ fill: {field}; stroke: {line} }}
"""
_STYLE = (
    "\nsvg { font: 12px ui-monospace, Menlo, Consolas, 'DejaVu Sans Mono', monospace }\n"
    ".box, .field { stroke-width: 1.5 } .inner { fill: none } .note { stroke-dasharray: 3 3 }\n"
    ".line { fill: none; stroke-width: 1.3 } .name { font-weight: 600 } .circle { stroke-width: 1.3 }\n"
    ".rail { stroke-width: 3 }"
    + _RULES.format(**_LIGHT)
    + "@media (prefers-color-scheme: dark) {"
    + _RULES.format(**_DARK)
    + "}\n"
)


class Canvas:
    """A drawing to which parts are added. It is as large as its parts."""

    def __init__(self) -> None:
        self._parts: list[str] = []
        self._low = [0.0, 0.0]
        self._high = [0.0, 0.0]
        self._empty = True

    def _holds(self, *points: tuple[float, float]) -> None:
        if self._empty:
            self._low, self._high, self._empty = list(points[0]), list(points[0]), False
        for point in points:
            self._low = [min(pair) for pair in zip(self._low, point, strict=True)]
            self._high = [max(pair) for pair in zip(self._high, point, strict=True)]

    @contextmanager
    def group(self, kind: str, title: str = "", **data: str) -> Iterator[None]:
        """Put the parts of the block into a group of the class `kind`, with `data` as its attributes ``data-``."""
        attributes = "".join(f' data-{name}="{escape(value)}"' for name, value in data.items())
        self._parts.append(f'<g class="{kind}"{attributes}>')
        if title:
            self._parts.append(f"<title>{escape(title)}</title>")
        yield
        self._parts.append("</g>")

    def rect(self, x: float, y: float, width: float, height: float, kind: str = "box") -> None:
        self._holds((x, y), (x + width, y + height))
        self._parts.append(
            f'<rect class="{kind}" x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" rx="2"/>'
        )

    def line(self, *points: tuple[float, float], kind: str = "line") -> None:
        """Draw a line through `points`."""
        self._holds(*points)
        path = " L".join(f"{x:.1f},{y:.1f}" for x, y in points)
        self._parts.append(f'<path class="{kind}" d="M{path}"/>')

    def tip(self, x: float, y: float) -> None:
        """Draw the tip of an arrow that ends at (x, y) from above."""
        self._parts.append(
            f'<path class="tip" d="M{x:.1f},{y:.1f} L{x - 4.5:.1f},{y - 9:.1f} L{x + 4.5:.1f},{y - 9:.1f} Z"/>'
        )

    def circle(self, x: float, y: float, radius: float, kind: str = "circle") -> None:
        self._holds((x - radius, y - radius), (x + radius, y + radius))
        self._parts.append(f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}"/>')

    def text(self, x: float, y: float, text: str, kind: str = "", anchor: str = "middle") -> None:
        """Write one line of text with its baseline at `y`. `anchor` says where in the text `x` is: start, middle or end."""
        width = len(text) * CHAR
        left = x - {"start": 0.0, "middle": 0.5, "end": 1.0}[anchor] * width
        self._holds((left, y - 11), (left + width, y + 4))
        named = f' class="{kind}"' if kind else ""
        placed = f' text-anchor="{anchor}"' if anchor != "start" else ""
        self._parts.append(f'<text{named} x="{x:.1f}" y="{y:.1f}"{placed}>{escape(text)}</text>')

    def svg(self, title: str, style: bool = True) -> str:
        """Return the drawing as SVG text; without `style`, a page has the style and the background."""
        left, top = (value - _MARGIN for value in self._low)
        width, height = (high - low + 2 * _MARGIN for high, low in zip(self._high, self._low, strict=True))
        place = f'x="{left:.0f}" y="{top:.0f}" width="{width:.0f}" height="{height:.0f}"'
        head = f'<svg xmlns="http://www.w3.org/2000/svg" class="drawing" viewBox="{left:.0f} {top:.0f} {width:.0f} {height:.0f}"'
        ground = f'<style>{_STYLE}</style><rect class="ground" {place}/>' if style else ""
        return "\n".join([
            f'{head} width="{width:.0f}" height="{height:.0f}" role="img"><title>{escape(title)}</title>{ground}',
            *self._parts, "</svg>", "",
        ])  # fmt: skip


def wrapped(text: str, most: int, lines: int) -> list[str]:
    """Return `text` in at most `lines` lines of about `most` characters, broken at blanks, with an ellipsis for the rest."""
    found: list[str] = []
    for word in text.split():
        if found and len(found[-1]) + len(word) < most:
            found[-1] += f" {word}"
        else:
            found.append(word)
    found = [shortened(line, most + 8) for line in found]
    if len(found) > lines:
        found[lines - 1 :] = [f"{found[lines - 1]} …"]
    return found


def shortened(text: str, most: int) -> str:
    """Return `text` with at most `most` characters."""
    return text if len(text) <= most else f"{text[: most - 1]}…"


def widest(lines: Sequence[str]) -> float:
    """Return the width of the longest of `lines`, in px."""
    return max((len(line) for line in lines), default=0) * CHAR
