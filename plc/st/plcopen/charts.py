"""Read a body in Sequential Function Chart (PLCopen TC6 XML 2.01, 6.5.1) into the tree.

The file connects steps, transitions, divergences and convergences in the direction against the flow. A transition between steps
is found by following these connections from the transition to its sources, and from each step to the transitions that lead to
it. A jump leads to the step that it names. Alternatives without a priority are tried from left to right.

Blocks, contacts, coils and variables next to the chart are a network in LD or FBD. A condition may be connected to it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

from fieldtwin.plc.st.plcopen.elements import Element
from fieldtwin.plc.st.plcopen.networks import Drawing, Drawn, drawn
from fieldtwin.plc.st.plcopen.nodes import Node, nodes_of, pin_of, refuse_elements
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.parse import parse_expression, parse_statements

_ASSIGNS = re.compile(r"[A-Za-z_][\w.]*\s*:=|(?:IF|CASE|FOR|WHILE|REPEAT)\b|.*;\s*\S", re.IGNORECASE | re.DOTALL)
"""The beginning of a body that assigns its condition, instead of being one."""
_UNSUPPORTED = ("macroStep", "jump", "label", "return", "error", "vendorElement")


@dataclass(frozen=True, slots=True)
class InlineAction:
    """An action whose statements are in an action block. `element` holds its text, `name` is made for it."""

    name: str
    element: Element


@dataclass(slots=True)
class ReadChart:
    """A chart, and the actions whose statements are in its action blocks."""

    drawn: Drawn
    inline: list[InlineAction]


def read_chart(
    body: Element, of: str, path: str, standard: Callable[[str], str], named: Mapping[str, Element]
) -> ReadChart:
    """Read a body. `of` is the name of the POU, `standard` changes an expression to that of the standard, and `named` has the
    bodies of the POU's transitions by their names in lower case.

    Raises `Unsupported` for an element that is not supported, and `FileInvalid` for an error.
    """
    refuse_elements(body, _UNSUPPORTED, of, path, " in a chart")
    return _Reader(nodes_of(body, of, path), standard, named).read()


class _Reader(Drawing):
    def __init__(self, nodes: dict[str, Node], standard: Callable[[str], str], named: Mapping[str, Element]) -> None:
        super().__init__(nodes, standard, "")
        self.named = named
        self.inline: list[InlineAction] = []

    def read(self) -> ReadChart:
        steps = [node for node in self.nodes.values() if node.tag == "step"]
        targets = self._targets()
        transitions = sorted(
            (node for node in self.nodes.values() if node.tag == "transition"), key=lambda n: (n.place[1], n.place[0])
        )
        chart = t.Chart(
            tuple(self._step(node) for node in steps),
            tuple(self._transition(node, tuple(targets.get(node.id, ()))) for node in transitions),
        )
        network = self.drawn()
        return ReadChart(Drawn((), network.edges, replace(chart, before=network.body)), self.inline)

    def _of(self, tag: str) -> Iterator[Node]:
        return (node for node in self.nodes.values() if node.tag == tag)

    # -- steps and their actions ------------------------------------------------------------------------------------------

    def _step(self, node: Node) -> t.Step:
        associations = [
            self._association(node, block, action)
            for block in self._of("actionBlock")
            if any(source == node.id for pin in block.pins for source, _ in pin.links)
            for action in block.element.children
            if action.tag == "action"
        ]
        initial = node.element.attributes.get("initialStep") == "true"
        return t.Step(node.pos, _name(node, "name"), initial, tuple(associations))

    def _association(self, step: Node, block: Node, action: Element) -> t.Association:
        reference, inline = action.find("reference"), action.find("inline")
        if reference is not None:
            name = reference.attributes.get("name", "").strip()
        elif inline is not None and (text := inline.find("ST")) is not None:
            name = f"{_name(step, 'name')}_inline{len(self.inline) + 1}"
            self.inline.append(InlineAction(name, text))
        else:
            raise block.unsupported("an action has neither a name nor statements in ST")
        qualifier = action.attributes.get("qualifier", "N").strip().upper()
        duration = action.attributes.get("duration", "").strip()
        given = (duration, action.attributes.get("indicator", "").strip())
        arguments = tuple(parse_expression(self.standard(text), block.pos) for text in given if text)
        return t.Association(block.pos, name, qualifier, arguments)

    # -- transitions ------------------------------------------------------------------------------------------------------

    def _transition(self, node: Node, targets: tuple[str, ...]) -> t.Transition:
        sources = tuple(dict.fromkeys(self._sources(node, frozenset())))
        if not sources or not targets:
            raise node.error(f"the transition has no step {'before' if not sources else 'after'} it")
        priority = node.element.attributes.get("priority", "").strip()
        number = int(priority) if priority.isascii() and priority.isdigit() else 0
        name, declared = self._declared(node)
        if declared is None:
            return t.Transition(node.pos, "", number or None, sources, targets, self._condition(node))
        body = self._body(node, name, declared)
        condition = t.Ref(node.pos, name) if body else self._in_text(node, declared)
        return t.Transition(node.pos, name if body else "", number or None, sources, targets, condition, body=body)

    def _sources(self, node: Node, seen: frozenset[str]) -> Iterator[str]:
        """Yield the steps from which a transition, or the element before it, comes."""
        for other in self._before(node, seen):
            if other.tag == "step":
                yield _name(other, "name")
            elif other.tag in ("selectionDivergence", "simultaneousConvergence"):
                yield from self._sources(other, seen | {node.id})
            else:
                raise node.error(f"a {node.tag} follows a {other.tag} (localId {other.id})")

    def _targets(self) -> dict[str, list[str]]:
        """Return the steps to which each transition leads, from left to right."""
        found: dict[str, list[str]] = {}
        reached = [(node, _name(node, "name")) for node in self._of("step")]
        reached += [(node, _name(node, "targetName")) for node in self._of("jumpStep")]
        for node, name in sorted(reached, key=lambda each: each[0].place[1]):
            for transition in self._leading_to(node, frozenset()):
                targets = found.setdefault(transition.id, [])
                if name not in targets:
                    targets.append(name)
        return found

    def _leading_to(self, node: Node, seen: frozenset[str]) -> Iterator[Node]:
        for other in self._before(node, seen):
            if other.tag == "transition":
                yield other
            elif other.tag in ("selectionConvergence", "simultaneousDivergence"):
                yield from self._leading_to(other, seen | {node.id})
            else:
                raise node.error(f"a {node.tag} follows a {other.tag} (localId {other.id})")

    def _before(self, node: Node, seen: frozenset[str]) -> Iterator[Node]:
        """Yield the elements to which the inputs of an element are connected."""
        if node.id in seen:
            raise node.error("a loop of divergences and convergences without a step")
        for pin in node.pins:
            yield from (self.nodes[source] for source, _ in pin.links)

    # -- conditions -------------------------------------------------------------------------------------------------------

    def _condition(self, node: Node) -> t.Expr:
        condition = node.element.find("condition")
        for part in condition.children if condition is not None else ():
            if part.tag == "reference":
                return self._parsed(node, part.attributes.get("name", "").strip())
            if part.tag == "inline":
                return self._in_text(node, part)
            if part.tag == "connectionPointIn":
                return self._flow(node, pin_of("", part, part))
        raise node.error("the transition has no condition")

    def _declared(self, node: Node) -> tuple[str, Element | None]:
        """Return the name in the condition of a transition, and the body that the POU has for this name."""
        condition = node.element.find("condition")
        reference = condition.find("reference") if condition is not None else None
        name = reference.attributes.get("name", "").strip() if reference is not None else ""
        return name, self.named.get(name.lower())

    def _body(self, node: Node, name: str, body: Element) -> tuple[t.Statement, ...]:
        """Return the statements of the body of a named transition; none if the body is only an expression."""
        language = next((part for part in body.children if part.tag in ("FBD", "LD")), None)
        if language is not None:
            found = drawn(language, f"transition {name}", node.pos.path, self.standard, name.lower())
            self.edges += found.edges
            return found.body
        text = _text(body.find("ST"))
        return parse_statements(self.standard(text), node.pos) if _ASSIGNS.match(text) else ()

    def _in_text(self, node: Node, body: Element) -> t.Expr:
        """Return a condition in ST: ``:= a AND b;``, as the standard writes it, or only the expression."""
        if body.find("ST") is None:
            raise node.unsupported("the condition of a transition has a body in another language than ST, LD and FBD")
        return self._parsed(node, _text(body.find("ST")).removeprefix(":=").rstrip("; \t\r\n"))

    def _source(self, node: Node, source: str, output: str) -> t.Expr:
        other = self.nodes.get(source)
        if other is None:
            raise node.error(f"a connection to the element {source}, which does not exist")
        if other.tag == "step":
            return t.Ref(node.pos, _name(other, "name"), (t.Member(node.pos, "X"),))
        return super()._source(node, source, output)


def _text(element: Element | None) -> str:
    return "".join(piece for _, piece in element.texts()).strip() if element is not None else ""


def _name(node: Node, attribute: str) -> str:
    name = node.element.attributes.get(attribute, "").strip()
    if not name.isidentifier():
        raise node.error(f"the {node.tag} has no usable {attribute}: {name!r}")
    return name
