"""The parts of a body in FBD or LD between its labels, to which jumps lead (the execution control elements of IEC 61131-3, 8.1).

A label names the first network, in the order of execution, that has an element below the label or to the right of it. A label
with an ``executionOrderId`` stands after the elements whose numbers are not greater. A jump continues with the networks from its
label on, in the order of execution.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from fieldtwin.plc.st.plcopen.nodes import EXECUTED, Node, connected


@dataclass(slots=True)
class Part:
    """The elements from one label to the next, in their order. The first part of a body may have no label."""

    labels: list[str] = field(default_factory=list)
    nodes: list[Node] = field(default_factory=list)


def parts_of(order: Sequence[Node], nodes: Mapping[str, Node]) -> list[Part]:
    """Return the parts of a body with the elements `nodes`, of which `order` are executed in this order.

    Raises `FileInvalid` for a label without a name, for two labels with one name, and for an element that reads the result of an
    element in a different part, because a jump may leave it out.
    """
    labels = _labels(nodes)
    networks = _networks(order)
    starts: dict[int, list[str]] = {0: []}
    for label in sorted(labels, key=lambda node: (node.order, node.place)):
        starts.setdefault(_start(label, order, networks), []).append(_name(label))
    firsts = sorted(starts)
    parts = [
        Part(starts[first], list(order[first:end]))
        for first, end in zip(firsts, [*firsts[1:], len(order)], strict=True)
    ]
    _check(parts, nodes)
    return parts


def _name(label: Node) -> str:
    return label.element.attributes.get("label", "").strip()


def _labels(nodes: Mapping[str, Node]) -> list[Node]:
    found: dict[str, Node] = {}
    for node in nodes.values():
        if node.tag == "label":
            name = _name(node).lower()
            if not name:
                raise node.error("the label has no name")
            if name in found:
                raise node.error(f"the label {_name(node)} is declared twice")
            found[name] = node
    return list(found.values())


def _networks(order: Sequence[Node]) -> list[tuple[int, list[Node]]]:
    """Return the groups of connected elements, each with the index of its first element in the order of execution."""
    by_id = {node.id: (index, node) for index, node in enumerate(order)}
    links = ((node.id, need) for node in order for need in node.needs)
    groups = connected(by_id, links)
    return [(min(by_id[one][0] for one in group), [by_id[one][1] for one in group]) for group in groups]


def _start(label: Node, order: Sequence[Node], networks: Sequence[tuple[int, list[Node]]]) -> int:
    """Return the index of the first element after a label, or the number of elements for a label at the end."""
    if label.order:
        return max((n + 1 for n, node in enumerate(order) if 0 < node.order <= label.order), default=0)
    after = (first for first, group in networks if max(node.place for node in group) > label.place)
    return min(after, default=len(order))


def _check(parts: Sequence[Part], nodes: Mapping[str, Node]) -> None:
    part_of = {node.id: number for number, part in enumerate(parts) for node in part.nodes}
    for number, part in enumerate(parts):
        for node in part.nodes:
            for need, last_will_do in node.needs.items():
                if nodes[need].tag in EXECUTED and part_of[need] != number and not last_will_do:
                    raise node.error(
                        f"a label separates it from the {nodes[need].tag} with localId {need}, whose result it reads; "
                        "put a variable between"
                    )
