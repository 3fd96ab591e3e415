"""The elements of a body in FBD or LD, and the order in which they are executed (IEC 61131-3, 8.1.3 and 8.3.3).

With ``executionOrderId``, elements are executed in the order of these numbers. Otherwise networks are executed from top to
bottom, and the elements of a network in the direction of the data, from top to bottom and from left to right where the data
leave the order open. In a loop, the element that is executed first reads the last value of a function block's output; a loop
without a function block has no such value and is refused.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.plcopen.elements import Element
from fieldtwin.plc.st.syntax.tree import Pos

MAX_NODES = 5_000
"""The largest number of elements in one body."""
EXECUTED = ("block", "contact", "coil", "outVariable", "inOutVariable", "jump", "return")


class Unsupported(FileInvalid):
    """A POU, an action or a type has a part that is not supported. The rest of the export can be used."""


@dataclass(slots=True)
class Pin:
    """An input: the elements and outputs that are connected to it, or an expression."""

    name: str
    element: Element
    links: list[tuple[str, str]]
    expression: str = ""


@dataclass(slots=True)
class Node:
    """An element of a body with its inputs. `order` is its number in the order of execution, 0 without one."""

    id: str
    element: Element
    pos: Pos
    place: tuple[float, float, int]
    """The distance from the top and from the left, and the position in the file."""
    order: int
    pins: list[Pin] = field(default_factory=list)
    needs: dict[str, bool] = field(default_factory=dict)
    """The executed elements whose results it reads; true if their last value will do, as for a function block."""

    @property
    def tag(self) -> str:
        return self.element.tag

    @property
    def is_instance(self) -> bool:
        return self.tag == "block" and bool(self.element.attributes.get("instanceName"))

    def error(self, message: str) -> FileInvalid:
        return self._made(FileInvalid, message)

    def unsupported(self, message: str) -> FileInvalid:
        return self._made(Unsupported, message)

    def _made(self, kind: type[FileInvalid], message: str) -> FileInvalid:
        where = f"{self.pos.element}: {message}"
        return kind(where, path=self.pos.path, line=self.pos.line, column=self.pos.column)


def refuse_elements(body: Element, tags: Container[str], of: str, path: str, where: str = "") -> None:
    """Raise `Unsupported` for the first element of a body that is one of `tags`. `of` is the name of the POU or action."""
    for element in body.children:
        if element.tag in tags:
            local = element.attributes.get("localId", "")
            raise Unsupported(
                f"{of} has the element {element.tag} (localId {local}){where}, which is not supported",
                path=path, line=element.line, column=element.column,
            )  # fmt: skip


def nodes_of(body: Element, of: str, path: str) -> dict[str, Node]:
    """Return the elements of a body by their localId. `of` is the name of the POU or action. Raises `FileInvalid`."""
    found: dict[str, Node] = {}
    for element in body.children:
        if "localId" not in element.attributes:
            continue
        local = element.attributes["localId"].strip()
        pos = Pos(element.line, element.column, path, f"localId {local} of {of}")
        node = Node(local, element, pos, _place(element, len(found)), 0)
        if not (local.isascii() and local.isdigit()):
            raise node.error("the localId is not a number")
        if local in found:
            raise node.error("the localId is used twice")
        if len(found) >= MAX_NODES:
            raise node.error(f"the body has more than {MAX_NODES} elements")
        node.order = _order(node)
        node.pins = list(_pins(element))
        found[local] = node
    _connect(found)
    return found


def _place(element: Element, index: int) -> tuple[float, float, int]:
    position = element.find("position")
    attributes = position.attributes if position is not None else {}
    try:
        return float(attributes.get("y", 0)), float(attributes.get("x", 0)), index
    except ValueError:
        return 0.0, 0.0, index


def _order(node: Node) -> int:
    text = node.element.attributes.get("executionOrderId", "0").strip()
    if not (text.isascii() and text.isdigit()):
        raise node.error(f"executionOrderId {text!r} is not a number")
    return int(text)


def _pins(element: Element) -> Iterator[Pin]:
    if element.tag != "block":
        yield from (pin_of("", element, point) for point in element.children if point.tag == "connectionPointIn")
        return
    for variables in ("inputVariables", "inOutVariables"):
        for variable in element.inside(variables):
            point = variable.find("connectionPointIn")
            if variable.tag == "variable" and point is not None:
                yield pin_of(variable.attributes.get("formalParameter", ""), variable, point)


def pin_of(name: str, element: Element, point: Element) -> Pin:
    """Return the input whose connections are in `point`, a ``<connectionPointIn>``."""
    links = [
        (c.attributes.get("refLocalId", "").strip(), c.attributes.get("formalParameter", ""))
        for c in point.children
        if c.tag == "connection"
    ]
    return Pin(name, element, links, written(point))


def written(element: Element) -> str:
    """Return the text of the child ``<expression>``, or "" without one."""
    expression = element.find("expression")
    return "".join(text for _, text in expression.texts()).strip() if expression is not None else ""


def _connect(nodes: dict[str, Node]) -> None:
    """Replace the links to continuations by the links of their connectors, and note which element needs which."""
    connectors = {n.element.attributes.get("name", ""): n for n in nodes.values() if n.tag == "connector"}
    for node in nodes.values():
        for pin in node.pins:
            pin.links = [link for one in pin.links for link in _resolved(node, one, nodes, connectors)]
            for source, output in pin.links:
                if nodes[source].tag in EXECUTED:
                    last_will_do = nodes[source].is_instance and output.upper() != "ENO"
                    node.needs[source] = node.needs.get(source, True) and last_will_do


def _resolved(
    node: Node, link: tuple[str, str], nodes: dict[str, Node], connectors: dict[str, Node]
) -> Iterator[tuple[str, str]]:
    waiting, seen = [link], set()
    while waiting:
        source, output = waiting.pop(0)
        found = nodes.get(source)
        if found is None:
            raise node.error(f"a connection to the element {source}, which does not exist")
        if found.tag != "continuation":
            yield source, output
            continue
        name = found.element.attributes.get("name", "")
        if name not in connectors or source in seen:
            raise found.error(f"the continuation {name!r} has no connector" if source not in seen else "a loop")
        seen.add(source)
        waiting += [each for pin in connectors[name].pins for each in pin.links]


# -- the order of execution ---------------------------------------------------------------------------------------------


def in_order(nodes: dict[str, Node]) -> list[Node]:
    """Return the executed elements in their order. Raises `FileInvalid` for a loop without a function block."""
    executed = {n.id: n for n in nodes.values() if n.tag in EXECUTED}
    numbered = sorted((n for n in executed.values() if n.order), key=lambda n: (n.order, n.place))
    found: list[Node] = []
    rest = {n.id: n for n in executed.values() if not n.order}
    for node in numbered:  # elements without a number, such as contacts, are executed when they are needed
        before = _before(node, rest)
        found += _by_flow(before)
        for one in before:
            del rest[one.id]
        found.append(node)
    for network in _networks(rest):
        found += _by_flow(network)
    _check(found, executed)
    return found


def _before(node: Node, rest: dict[str, Node]) -> list[Node]:
    """Return the elements in `rest` from which the inputs of `node` come, through elements in `rest` only."""
    found: dict[str, Node] = {}
    waiting = [rest[need] for need in node.needs if need in rest]
    while waiting:
        one = waiting.pop()
        if one.id not in found:
            found[one.id] = one
            waiting += [rest[need] for need in one.needs if need in rest]
    return list(found.values())


def _networks(nodes: dict[str, Node]) -> list[list[Node]]:
    """Return the groups of connected elements, from top to bottom."""
    links = ((node.id, need) for node in nodes.values() for need in node.needs)
    networks = [[nodes[one] for one in network] for network in connected(nodes, links)]
    return sorted(networks, key=lambda network: min(node.place for node in network))


def connected(ids: Iterable[str], links: Iterable[tuple[str, str]]) -> list[list[str]]:
    """Return the groups of `ids` that are connected by `links`, directly or through others. Links to other ids do not count."""
    neighbours: dict[str, set[str]] = {one: set() for one in ids}
    for first, second in links:
        if first in neighbours and second in neighbours:
            neighbours[first].add(second)
            neighbours[second].add(first)
    groups: list[list[str]] = []
    seen: set[str] = set()
    for start in neighbours:
        waiting, group = [start], list[str]()
        while waiting:
            one = waiting.pop()
            if one not in seen:
                seen.add(one)
                group.append(one)
                waiting += neighbours[one]
        if group:
            groups.append(group)
    return groups


def _by_flow(nodes: Iterable[Node]) -> list[Node]:
    """Return connected elements in the direction of the data."""
    remaining = {n.id: n for n in nodes}
    readers: dict[str, list[str]] = {n: [] for n in remaining}
    pending = {n.id: {need for need in n.needs if need in remaining} for n in remaining.values()}
    for node, needs in pending.items():
        for need in needs:
            readers[need].append(node)
    ready = [(n.place, n.id) for n in remaining.values() if not pending[n.id]]
    heapify(ready)
    found: list[Node] = []
    while remaining:
        one = heappop(ready)[1] if ready else _first_of_a_loop(remaining, pending)
        found.append(remaining.pop(one))
        for reader in readers[one]:
            if reader in remaining and one in pending[reader]:
                pending[reader].discard(one)
                if not pending[reader]:
                    heappush(ready, (remaining[reader].place, reader))
    return found


def _first_of_a_loop(remaining: dict[str, Node], pending: dict[str, set[str]]) -> str:
    """Return the leftmost element of a loop whose other inputs are known and whose missing inputs have a last value."""
    leftmost = sorted(remaining.values(), key=lambda n: (n.place[1], n.place[0], n.place[2]))
    for node in leftmost:
        if all(node.needs[need] for need in pending[node.id]) and _reaches_itself(node.id, pending):
            return node.id
    return leftmost[0].id


def _reaches_itself(start: str, pending: dict[str, set[str]]) -> bool:
    waiting, seen = list(pending[start]), set()
    while waiting:
        one = waiting.pop()
        if one == start:
            return True
        if one not in seen:
            seen.add(one)
            waiting += pending[one]
    return False


def _check(order: list[Node], executed: dict[str, Node]) -> None:
    done: set[str] = set()
    for node in order:
        for need, last_will_do in node.needs.items():
            if need not in done and not last_will_do:
                other = executed[need]
                raise node.error(
                    f"it reads the result of the {other.tag} with localId {need}, which is executed later; put a variable between"
                )
        done.add(node.id)
