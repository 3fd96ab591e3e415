"""The elements of a body in Ladder Diagram or Function Block Diagram, with their sizes, pins, texts and connections.

Positions are those of the PLCopen XML file, if it has a different one for each element. Otherwise `places` arranges the elements.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from fieldtwin.plc.st.drawing.canvas import CHAR, LINE, wrapped
from fieldtwin.plc.st.plcopen.elements import Element
from fieldtwin.plc.st.plcopen.nodes import written

PIN = 22.0
"""The distance between two pins of a block that has no positions, in px."""
VARIABLE_H = 18.0
_SYMBOL = (30.0, 20.0)
_DRAWN = (
    "leftPowerRail", "rightPowerRail", "contact", "coil", "block", "inVariable", "outVariable", "inOutVariable", "connector",
    "continuation", "label", "jump", "return", "comment",
)  # fmt: skip
RAILS = ("leftPowerRail", "rightPowerRail")
SYMBOLS = ("contact", "coil")
MAX_FIGURES = 5_000


@dataclass(slots=True)
class Link:
    """A connection from the output `pin` of the element `source`; `route` are its points in the file, from the source."""

    source: str
    pin: str
    route: list[tuple[float, float]]


@dataclass(slots=True)
class Port:
    """An input or output of an element, at (`x`, `y`) from the upper left corner of the element."""

    name: str
    x: float = 0.0
    y: float = 0.0
    negated: bool = False
    edge: str = ""
    placed: bool = False
    links: list[Link] = field(default_factory=list)
    expression: str = ""


@dataclass(slots=True)
class Figure:
    """An element. `text` is its variable, expression or type, `above` the text over it, and `mark` the letter in a symbol."""

    id: str
    tag: str
    text: str
    above: str = ""
    mark: str = ""
    x: float = 0.0
    y: float = 0.0
    width: float = 0.0
    height: float = 0.0
    placed: bool = False
    inputs: list[Port] = field(default_factory=list)
    outputs: list[Port] = field(default_factory=list)

    @property
    def needed_width(self) -> float:
        """Return the width that the texts inside the element need."""
        if self.tag == "block":
            left = max((len(port.name) for port in self.inputs), default=0)
            right = max((len(port.name) for port in self.outputs), default=0)
            return max(len(self.text) * CHAR, (left + right) * CHAR + 14) + 14
        if self.tag in RAILS:
            return 4.0
        if self.tag in SYMBOLS:
            return _SYMBOL[0]
        if self.tag == "comment":
            return (min(len(self.text), 40) + 8) * CHAR + 16
        return len(self.text) * CHAR + 16

    @property
    def needed_height(self) -> float:
        """Return the height that the element needs without positions in the file."""
        if self.tag == "block":
            return 26 + PIN * max(len(self.inputs), len(self.outputs), 1)
        if self.tag == "comment":
            return LINE * len(wrapped(self.text, 40, 20)) + 10
        return _SYMBOL[1] if self.tag in SYMBOLS else VARIABLE_H

    @property
    def ports(self) -> Iterator[Port]:
        yield from self.inputs
        yield from self.outputs

    def output(self, pin: str) -> Port | None:
        """Return the output with a name; without one, the first output that is not ENO."""
        named = next((port for port in self.outputs if pin and port.name == pin), None)
        main = next((port for port in self.outputs if port.name.upper() != "ENO"), None)
        return named or main or next(iter(self.outputs), None)


def figures_of(body: Element) -> dict[str, Figure]:
    """Return the elements of a body that can be drawn, by their localId."""
    found: dict[str, Figure] = {}
    for element in body.children:
        local = element.attributes.get("localId", "").strip()
        if element.tag in _DRAWN and local and local not in found and len(found) < MAX_FIGURES:
            found[local] = _figure(local, element)
    return found


def _figure(local: str, element: Element) -> Figure:
    made = Figure(local, element.tag, _text(element), mark=_mark(element))
    if element.tag == "block":
        made.above = element.attributes.get("instanceName", "")
        made.inputs = [
            _port(v, "In") for kind in ("inputVariables", "inOutVariables") for v in _variables(element, kind)
        ]
        made.outputs = [
            _port(v, "Out") for kind in ("outputVariables", "inOutVariables") for v in _variables(element, kind)
        ]
    else:
        if element.tag in SYMBOLS:
            made.text, made.above = "", made.text
        points = [p for p in element.children if p.tag in ("connectionPointIn", "connectionPointOut")]
        made.inputs = [_joined("", p) for p in points if p.tag == "connectionPointIn"]
        made.outputs = [_joined("", p) for p in points if p.tag == "connectionPointOut"]
        if element.tag in ("inVariable", "inOutVariable") and not made.mark and made.outputs:
            made.outputs[0].negated = element.attributes.get("negated") == "true"
        if element.tag == "outVariable" and made.inputs:
            made.inputs[0].negated = element.attributes.get("negated") == "true"
    made.width, made.height = _number(element, "width"), _number(element, "height")
    position = element.find("position")
    if position is not None:
        made.x, made.y, made.placed = _number(position, "x"), _number(position, "y"), True
    return made


def _variables(element: Element, kind: str) -> list[Element]:
    return [variable for variable in element.inside(kind) if variable.tag == "variable"]


def _port(variable: Element, side: str) -> Port:
    point = variable.find(f"connectionPoint{side}")
    made = _joined(variable.attributes.get("formalParameter", ""), point) if point is not None else Port("")
    made.name = variable.attributes.get("formalParameter", "")
    made.negated = variable.attributes.get("negated") == "true"
    made.edge = variable.attributes.get("edge", "none").replace("none", "")
    return made


def _joined(name: str, point: Element) -> Port:
    made = Port(name)
    relative = point.find("relPosition")
    if relative is not None:
        made.x, made.y, made.placed = _number(relative, "x"), _number(relative, "y"), True
    made.expression = written(point)
    for one in point.children:
        if one.tag == "connection":
            route = [(_number(p, "x"), _number(p, "y")) for p in one.children if p.tag == "position"]
            source = one.attributes.get("refLocalId", "").strip()
            made.links.append(Link(source, one.attributes.get("formalParameter", ""), route[::-1]))
    return made


def _text(element: Element) -> str:
    if element.tag == "block":
        return element.attributes.get("typeName", "")
    if element.tag in SYMBOLS:
        variable = element.find("variable")
        return "".join(text for _, text in variable.texts()).strip() if variable is not None else ""
    if element.tag in ("connector", "continuation"):
        name = element.attributes.get("name", "")
        return f"{name} >" if element.tag == "connector" else f"> {name}"
    if element.tag == "comment":
        return " ".join("".join(text for _, text in element.texts()).split())
    named = {"label": "{}:", "jump": "{}", "return": "<RETURN>"}.get(element.tag)
    return named.format(element.attributes.get("label", "")) if named is not None else written(element)


def _mark(element: Element) -> str:
    """Return the letter inside a contact or coil."""
    attributes = element.attributes
    if element.tag not in SYMBOLS:
        return ""
    edge = {"rising": "P", "falling": "N"}.get(attributes.get("edge", ""), "")
    stored = {"set": "S", "reset": "R"}.get(attributes.get("storage", ""), "")
    return edge or stored or ("/" if attributes.get("negated") == "true" else "")


def _number(element: Element, name: str) -> float:
    try:
        value = float(element.attributes.get(name, 0))
    except ValueError:
        return 0.0
    return value if abs(value) < 1e6 else 0.0
