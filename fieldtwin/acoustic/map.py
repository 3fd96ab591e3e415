"""A network as a map: the positions of its systems, with distance and delay between those that hear each other.

This module converts a loaded network to text and SVG; it opens no files or connections.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from itertools import combinations
from math import dist
from typing import Any

from fieldtwin.acoustic.network import Network
from fieldtwin.acoustic.schema import SHIP
from fieldtwin.reports.drawing.svg import CHAR, EDGE, LINE, document
from fieldtwin.reports.markup import Markup, el

WIDE, HIGH, LOW = 760.0, 420.0, 120.0
"""The area of the drawing in which the places lie, in px: its width, its greatest and its smallest height."""
AROUND = 110.0
"""The margin for the labels of places at the edge, in px."""


@dataclass(frozen=True, slots=True)
class MemberPosition:
    """A member: a system with its file and devices, or the topside controller. `at_m` is its
    position in m, as in the network file.
    """

    name: str
    system: str
    devices: tuple[str, ...]
    at_m: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class AcousticPath:
    """Two members that hear each other, with their distance and the sound's travel time."""

    one: str
    other: str
    distance_m: float
    sound_s: float

    @property
    def said(self) -> str:
        return f"{self.distance_m / 1000:.1f} km, {self.sound_s:.1f} s"


@dataclass(frozen=True, slots=True)
class Map:
    """The positions of a network's systems, the acoustic paths between them, and a description of the acoustic channel."""

    network: str
    water: str
    places: tuple[MemberPosition, ...]
    ways: tuple[AcousticPath, ...]

    def as_data(self) -> dict[str, Any]:
        """Return the map as JSON data."""
        return asdict(self)


def network_map(network: Network) -> Map:
    """Return the map of `network`."""
    water, members = network.water, network.members
    where = network.places
    places = [
        MemberPosition(name, m.system.name, tuple(m.system.devices), tuple(where[name])) for name, m in members.items()
    ]
    if SHIP in where:
        places.append(MemberPosition(SHIP, "", (), tuple(where[SHIP])))
    apart = [(a.name, b.name, dist(a.at_m, b.at_m)) for a, b in combinations(places, 2)]
    ways = [
        AcousticPath(a, b, round(d, 1), round(d / water.sound_m_per_s, 3)) for a, b, d in apart if d <= water.range_m
    ]
    said = f"range {water.range_m / 1000:g} km, {water.bytes_per_s:g} byte/s, {water.loss * 100:g} % lost by chance"
    return Map(network.name, said, tuple(places), tuple(ways))


def text(drawn: Map) -> str:
    """Return one line of text for each member: its position, and the members that it hears."""
    names = max(len(place.name) for place in drawn.places)
    systems = max(len(place.system) for place in drawn.places)
    lines = [f"{drawn.network} (network of prototypes)", f"water: {drawn.water}"]
    for n, place in enumerate(drawn.places):
        heard = [
            (w.other if w.one == place.name else w.one, w.said) for w in drawn.ways if place.name in (w.one, w.other)
        ]
        hears = "; ".join(f"{name} ({said})" for name, said in heard) or "nobody"
        branch = "└─" if n == len(drawn.places) - 1 else "├─"
        lines.append(f"{branch} {place.name.ljust(names)}  {place.system.ljust(systems)}  hears {hears}")
    return "\n".join(lines) + "\n"


def svg(drawn: Map) -> str:
    """Return the map as SVG, with x to the right, y up, and the depth as text."""
    spots, height = _spots(drawn)
    width = WIDE + 2 * AROUND
    parts = [_way(way, spots) for way in drawn.ways]
    taken: list[tuple[float, float, float, float]] = []
    parts += [_place(place, spots[place.name], taken) for place in drawn.places]
    title = f"{drawn.network}: network of prototypes"
    heads = [
        el("text", title, cls="name", x=EDGE, y=EDGE + 8),
        el("text", drawn.water, cls="soft", x=EDGE, y=EDGE + 8 + LINE),
    ]
    return document(title, width, height, heads, parts)


def _spots(drawn: Map) -> tuple[dict[str, tuple[float, float]], float]:
    """Return the drawn position of each member in px, all in one scale, and the drawing's height in px."""
    xs, ys = [p.at_m[0] for p in drawn.places], [p.at_m[1] for p in drawn.places]
    across, up = max(xs) - min(xs), max(ys) - min(ys)
    scale = min(WIDE / across if across else 1e9, HIGH / up if up else 1e9) if across or up else 1.0
    high = max(LOW, up * scale)
    left = AROUND + (WIDE - across * scale) / 2
    bottom = EDGE + 60 + high - (high - up * scale) / 2
    spots = {
        p.name: (left + (p.at_m[0] - min(xs)) * scale, bottom - (p.at_m[1] - min(ys)) * scale) for p in drawn.places
    }
    return spots, EDGE + 60 + high + 5 * LINE + EDGE


def _way(way: AcousticPath, spots: dict[str, tuple[float, float]]) -> list[Markup]:
    (x1, y1), (x2, y2) = spots[way.one], spots[way.other]
    at = ((x1 + x2) / 2, (y1 + y2) / 2 - 8)
    return [
        el("path", cls="line emulated", d=f"M{x1:.1f},{y1:.1f} L{x2:.1f},{y2:.1f}"),
        el("text", way.said, cls="says halo", x=at[0] - len(way.said) * CHAR / 2, y=at[1]),
    ]


def _place(
    place: MemberPosition, spot: tuple[float, float], taken: list[tuple[float, float, float, float]]
) -> list[Markup]:
    """Draw a member as a dot, with its texts below the dot, or above it if there is already a label below."""
    metres = ", ".join(f"{m:g}" for m in place.at_m) + " m"
    rows = [(place.name, "name"), (place.system, ""), (", ".join(place.devices), "soft"), (metres, "soft")]
    rows = [row for row in rows if row[0]]
    wide = max(len(words) for words, _ in rows) * CHAR
    x, y = spot
    box = (x - wide / 2, y + 10, x + wide / 2, y + 14 + len(rows) * LINE)
    if any(box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in taken):
        box = (box[0], y - 14 - len(rows) * LINE, box[2], y - 10)
    taken.append(box)
    texts = [
        el("text", words, cls=cls or None, x=x - len(words) * CHAR / 2, y=box[1] + 12 + n * LINE)
        for n, (words, cls) in enumerate(rows)
    ]
    return [el("circle", cls="port", cx=x, cy=y, r=7), *texts]
