"""Draw a body in Ladder Diagram or Function Block Diagram as SVG, in the notation of IEC 61131-3 (8.2 and 8.3)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.st.drawing.canvas import CHAR, LINE, Canvas, shortened, wrapped
from fieldtwin.plc.st.drawing.figures import RAILS, Figure, Link, Port, figures_of
from fieldtwin.plc.st.drawing.places import networks_of, place, room_for
from fieldtwin.plc.st.plcopen.elements import Element

_HALF = 7.0
"""Half of the distance between the bars of a contact, in px."""
_RADIUS = 4.0
_Point = tuple[float, float]


def draw_network(body: Element, title: str, network: int = 0, style: bool = True) -> str:
    """Return a body as SVG text. `network` selects a group of connected elements, from 1; 0 draws all of them.

    Raises `UsageError` for an unknown network.
    """
    figures = figures_of(body)
    place(figures)
    shown = dict(figures)
    if network:
        networks = networks_of(figures)
        if not 1 <= network <= len(networks):
            raise UsageError(
                f"no network {network}", expected=f"1 to {len(networks)}" if networks else "a body with elements"
            )
        inside = {one.id for one in networks[network - 1]}
        shown = {name: one for name, one in figures.items() if name in inside or one.tag in RAILS}
        _shorten_rails(shown)
    canvas = Canvas()
    _Wires(shown).draw(canvas)
    for one in shown.values():
        with canvas.group(one.tag, _title(one), node=one.id):
            _DRAW.get(one.tag, _variable)(canvas, one, shown)
    return canvas.svg(title, style)


def count_networks(body: Element) -> int:
    """Return the number of networks of a body."""
    return len(networks_of(figures_of(body)))


def _title(one: Figure) -> str:
    return f"{one.above} {one.text}".strip()


def _shorten_rails(shown: Mapping[str, Figure]) -> None:
    """Make power rails as long as the other elements need."""
    others = [one for one in shown.values() if one.tag not in RAILS]
    low, high = min(one.y for one in others) - 10, max(one.y + one.height for one in others) + 10
    for one in shown.values():
        if one.tag in RAILS:
            for port in one.ports:
                port.y += one.y - low
            one.y, one.height = low, high - low


# -- connections ----------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Wire:
    """A connection, and the points through which it is drawn."""

    source: tuple[str, str]
    target: int
    points: list[_Point]


class _Wires:
    """The paths of the connections. Paths from different outputs have no line in common."""

    def __init__(self, shown: Mapping[str, Figure]) -> None:
        self.shown = shown
        self.wires: list[_Wire] = []
        for one in shown.values():
            for port in one.inputs:
                for link in port.links:
                    if link.source in shown:
                        points = _squared(self._path(one, port, link))
                        self.wires.append(_Wire((link.source, link.pin), id(port), points))

    def draw(self, canvas: Canvas) -> None:
        for wire in self.wires:
            with canvas.group("wire", **{"from": wire.source[0], "pin": wire.source[1]}):
                canvas.line(*wire.points)
        for point in sorted(set(self._junctions())):
            canvas.circle(*point, 2.5, "dot")

    def _path(self, one: Figure, port: Port, link: Link) -> list[_Point]:
        source = self.shown[link.source]
        end = (one.x + port.x, one.y + port.y)
        if one.tag in RAILS:
            end = (one.x, end[1])
        output = source.output(link.pin)
        begin = (source.x + source.width, source.y + source.height / 2)
        if output is not None:
            begin = (source.x + output.x, source.y + output.y)
        if source.tag in RAILS:
            y = link.route[0][1] if link.route else end[1]
            begin = (source.x + source.width, min(max(y, source.y), source.y + source.height))
        if one.tag in RAILS and not link.route:
            end = (end[0], begin[1])
        if len(link.route) > 1:
            return [begin, *link.route[1:-1], end]
        return self._free_path(begin, end, one, source, (link.source, link.pin))

    def _free_path(
        self, begin: _Point, end: _Point, one: Figure, source: Figure, output: tuple[str, str]
    ) -> list[_Point]:
        """Return a path of vertical and horizontal lines. A path back to the left passes below both elements."""
        if end[0] <= begin[0]:
            below = max(one.y + one.height, source.y + source.height) + 14
            right = begin[0] + 12
            return [begin, (right, begin[1]), (right, below), (end[0] - 12, below), (end[0] - 12, end[1]), end]
        low, high = sorted((begin[1], end[1]))
        turn = end[0] - 16
        while turn > begin[0] + 8 and self._is_taken(turn, low, high, output):
            turn -= 8
        turn = max(begin[0] + 4, turn)
        return [begin, (turn, begin[1]), (turn, end[1]), end]

    def _is_taken(self, x: float, low: float, high: float, output: tuple[str, str]) -> bool:
        """Return whether a vertical line of the path from a different output is at this place."""
        return any(
            abs(a[0] - x) < 5 and abs(b[0] - x) < 5 and min(a[1], b[1]) <= high and max(a[1], b[1]) >= low
            for wire in self.wires if wire.source != output
            for a, b in pairwise(wire.points) if a[1] != b[1]
        )  # fmt: skip

    def _junctions(self) -> Iterator[_Point]:
        """Yield the points at which paths from one output part, or paths to one input meet."""
        for wire in self.wires:
            for other in self.wires:
                if other is not wire and (other.source == wire.source or other.target == wire.target):
                    corners = wire.points[1:-1]
                    yield from (c for c in corners if any(_inside(c, a, b) for a, b in pairwise(other.points)))


def _inside(point: _Point, a: _Point, b: _Point) -> bool:
    """Return whether a point is within a horizontal or vertical line, and not at its ends."""
    x, y = point
    if abs(a[1] - b[1]) < 0.1:
        return abs(y - a[1]) < 0.1 and min(a[0], b[0]) + 0.1 < x < max(a[0], b[0]) - 0.1
    return abs(x - a[0]) < 0.1 and min(a[1], b[1]) + 0.1 < y < max(a[1], b[1]) - 0.1


def _squared(points: list[_Point]) -> list[_Point]:
    """Return a path without diagonal lines and without points that change nothing."""
    found = [points[0]]
    for number, (x, y) in enumerate(points[1:], 1):
        last = found[-1]
        if abs(last[0] - x) > 0.05 and abs(last[1] - y) > 0.05:
            bend = (last[0] + x) / 2 if len(points) == 2 else x if number == 1 else last[0]
            found += [(bend, last[1]), (bend, y)]
        found.append((x, y))
    kept = [found[0]]
    for point in found[1:]:
        if len(kept) > 1 and _inside(kept[-1], kept[-2], point):
            kept.pop()
        if point != kept[-1]:
            kept.append(point)
    return kept


# -- elements -------------------------------------------------------------------------------------------------------------


def _rail(canvas: Canvas, one: Figure, shown: Mapping[str, Figure]) -> None:
    x = one.x + one.width if one.tag == "leftPowerRail" else one.x
    canvas.line((x, one.y), (x, one.y + one.height), kind="line rail")


def _middle(one: Figure) -> tuple[float, float]:
    ports = [*one.inputs, *one.outputs]
    y = one.y + (ports[0].y if ports else one.height / 2)
    return one.x + one.width / 2, y


def _symbol(canvas: Canvas, one: Figure, shown: Mapping[str, Figure]) -> None:
    x, y = _middle(one)
    for port, side in [*((p, -1) for p in one.inputs), *((p, 1) for p in one.outputs)]:
        canvas.line((one.x + port.x, y), (x + side * _HALF, y))
    if one.tag == "contact":
        for side in (-1, 1):
            canvas.line((x + side * _HALF, y - 9), (x + side * _HALF, y + 9), kind="line bold")
    else:
        for side in (-1, 1):
            canvas.line((x + side * _HALF - side * 3, y - 9), (x + side * (_HALF + 1), y - 4), (x + side * (_HALF + 1), y + 4),
                        (x + side * _HALF - side * 3, y + 9), kind="line bold")  # fmt: skip
    if one.mark:
        canvas.text(x, y + 4, one.mark, "name")
    most = int(room_for(one, shown.values()) / CHAR)
    canvas.text(x, y - 14, shortened(one.above, max(3, most)), "name")


def _block(canvas: Canvas, one: Figure, shown: Mapping[str, Figure]) -> None:
    canvas.rect(one.x, one.y, one.width, one.height)
    most = int(one.width / CHAR)
    canvas.text(one.x + one.width / 2, one.y + 14, shortened(one.text, most), "name")
    if one.above:
        room = int(room_for(one, shown.values()) / CHAR)
        canvas.text(one.x + one.width / 2, one.y - 6, shortened(one.above, max(3, room)))
    half = int((one.width - 16) / 2 / CHAR)
    sides = [len(port.name) for port in one.inputs], [len(port.name) for port in one.outputs]
    fits = max(sides[0], default=0) + max(sides[1], default=0) <= 2 * half
    for port, inward, anchor in [*((p, 1, "start") for p in one.inputs), *((p, -1, "end") for p in one.outputs)]:
        x, y = one.x + port.x, one.y + port.y
        name = port.name if fits else shortened(port.name, max(1, half))
        canvas.text(x + inward * 7, y + 4, name, "soft", anchor)
        if port.negated:
            canvas.circle(x - inward * _RADIUS, y, _RADIUS)
        if port.edge:
            canvas.line((x, y - 5), (x + inward * 6, y), (x, y + 5))
        if port.expression:
            canvas.text(x - inward * 6, y + 4, port.expression, anchor="end" if inward > 0 else "start")


def _variable(canvas: Canvas, one: Figure, shown: Mapping[str, Figure]) -> None:
    canvas.rect(one.x, one.y, one.width, one.height, "field")
    most = int((one.width - 6) / CHAR)
    canvas.text(one.x + one.width / 2, one.y + one.height / 2 + 4, shortened(one.text, max(3, most)))
    for port, inward in [*((p, 1) for p in one.inputs), *((p, -1) for p in one.outputs)]:
        if port.negated:
            canvas.circle(one.x + port.x - inward * _RADIUS, one.y + port.y, _RADIUS)


def _control(canvas: Canvas, one: Figure, shown: Mapping[str, Figure]) -> None:
    """Draw a label, a jump or a return as the standard does: its text without a box, behind a double arrow for a jump."""
    middle, left = one.y + one.height / 2, one.x
    if one.tag == "jump":
        for tip in (left + 6, left + 12):
            canvas.line((tip - 6, middle - 6), (tip, middle), (tip - 6, middle + 6))
        left += 14
    most = int((one.x + one.width - left) / CHAR)
    canvas.text(left + 2, middle + 4, shortened(one.text, max(3, most)), "name", "start")


def _comment(canvas: Canvas, one: Figure, shown: Mapping[str, Figure]) -> None:
    lines = wrapped(one.text, max(8, int((one.width - 12) / CHAR) - 8), max(1, int((one.height - 6) / LINE)))
    canvas.rect(one.x, one.y, one.width, one.height, "note")
    for number, line in enumerate(lines):
        canvas.text(one.x + 7, one.y + 15 + number * LINE, line, "soft", "start")


_DRAW = {
    "leftPowerRail": _rail, "rightPowerRail": _rail, "contact": _symbol, "coil": _symbol, "block": _block, "comment": _comment,
    "label": _control, "jump": _control, "return": _control,
}  # fmt: skip
