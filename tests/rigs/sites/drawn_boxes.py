"""Read a drawing back from its SVG text: boxes, texts and groups, with the places that they cover."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from xml.etree import ElementTree as ET

CHAR = 7.3
SVG = "{http://www.w3.org/2000/svg}"


@dataclass(frozen=True)
class Box:
    """A rectangle that a part of the drawing covers; `what` is its class, or the text."""

    what: str
    left: float
    top: float
    right: float
    bottom: float

    def covers(self, other: Box) -> bool:
        """Return whether both cover a common place. Boxes may touch."""
        across = min(self.right, other.right) - max(self.left, other.left)
        down = min(self.bottom, other.bottom) - max(self.top, other.top)
        return across > 0.5 and down > 0.5

    def holds(self, other: Box) -> bool:
        """Return whether `other` is inside this box."""
        return (
            self.left <= other.left + 0.5 and self.top <= other.top + 0.5
            and self.right >= other.right - 0.5 and self.bottom >= other.bottom - 0.5
        )  # fmt: skip


class Read:
    """The parts of a drawing, read from its SVG text."""

    def __init__(self, text: str) -> None:
        self.root = ET.fromstring(text)
        low_x, low_y, width, height = map(float, self.root.attrib["viewBox"].split())
        self.view = Box("view", low_x, low_y, low_x + width, low_y + height)
        rects = [e for e in self.root.iter(f"{SVG}rect") if e.attrib["class"] in ("box", "field", "bar", "note")]
        self.boxes = [_rect(e) for e in rects]
        self.texts = [_text(e) for e in self.root.iter(f"{SVG}text")]

    def groups(self, kind: str, attribute: str) -> list[str]:
        """Return the attribute ``data-...`` of the groups of a class."""
        return [e.attrib[f"data-{attribute}"] for e in self.root.iter(f"{SVG}g") if e.attrib["class"] == kind]

    def problems(self) -> list[str]:
        """Return what hides something else, or is outside of the drawing."""
        found = [f"{one} is outside" for one in (*self.boxes, *self.texts) if not self.view.holds(one)]
        found += [f"{a} and {b}" for a, b in combinations(self.boxes, 2) if a.covers(b)]
        found += [f"{a} and {b}" for a, b in combinations(self.texts, 2) if a.covers(b)]
        found += [f"{a} across {b}" for a in self.texts for b in self.boxes if a.covers(b) and not b.holds(a)]
        return found


def _rect(e: ET.Element) -> Box:
    x, y, width, height = (float(e.attrib[name]) for name in ("x", "y", "width", "height"))
    return Box(e.attrib["class"], x, y, x + width, y + height)


def _text(e: ET.Element) -> Box:
    text, x, y = e.text or "", float(e.attrib["x"]), float(e.attrib["y"])
    width = len(text) * CHAR
    left = x - {"start": 0.0, "middle": 0.5, "end": 1.0}[e.attrib.get("text-anchor", "start")] * width
    return Box(text, left, y - 9, left + width, y + 2)
