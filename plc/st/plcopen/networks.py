"""Translate a body in Function Block Diagram or Ladder Diagram to statements (IEC 61131-3, 8.2 and 8.3).

Contacts, coils, blocks and variables become the statements that they stand for, in the order of execution. The result of a
function and the state of a connection are kept in a `Hold`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from fieldtwin.plc.st.plcopen.elements import Element
from fieldtwin.plc.st.plcopen.labels import Part, parts_of
from fieldtwin.plc.st.plcopen.nodes import Node, Pin, in_order, nodes_of, refuse_elements, written
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.parse import parse_expression

_EDGES = {"rising": "R_TRIG", "falling": "F_TRIG"}


@dataclass(frozen=True, slots=True)
class Drawn:
    """The statements of a drawn body with its drawing, and the blocks for the edges that it detects; or a chart."""

    body: tuple[t.Statement, ...]
    edges: tuple[t.VarDecl, ...]
    chart: t.Chart | None = None
    graphic: t.Graphic | None = None


def drawn(body: Element, of: str, path: str, standard: Callable[[str], str], suffix: str = "") -> Drawn:
    """Translate a body. `of` is the name of the POU or action, `standard` changes an expression to that of the standard, and
    `suffix` makes the names of the blocks for edges unique.

    Raises `Unsupported` for an element that is not supported, and `FileInvalid` for an error.
    """
    refuse_elements(body, ("error", "actionBlock"), of, path)
    return replace(Drawing(nodes_of(body, of, path), standard, suffix).drawn(), graphic=t.Graphic(body))


class Drawing:
    """The translation of the blocks, contacts, coils and variables of a body."""

    def __init__(self, nodes: dict[str, Node], standard: Callable[[str], str], suffix: str) -> None:
        self.nodes = nodes
        self.standard = standard
        self.suffix = suffix
        self.out: list[t.Statement] = []
        self.edges: list[t.VarDecl] = []
        self.labels: frozenset[str] = frozenset()
        """The names of the labels of the body, in lower case."""

    def drawn(self) -> Drawn:
        parts = parts_of(in_order(self.nodes), self.nodes)
        self.labels = frozenset(name.lower() for part in parts for name in part.labels)
        networks = tuple(self._network(part) for part in parts)
        body = tuple(statement for network in networks for statement in network.body)
        if any(node.tag == "jump" for node in self.nodes.values()):
            body = (t.Networks(body[0].pos, networks),)
        return Drawn(body, tuple(self.edges))

    def _network(self, part: Part) -> t.Network:
        self.out = []
        for node in part.nodes:
            getattr(self, f"_{node.tag.lower()}")(node)
        return t.Network(tuple(part.labels), tuple(self.out))

    # -- values ---------------------------------------------------------------------------------------------------------

    def _parsed(self, node: Node, text: str) -> t.Expr:
        if not text:
            raise node.error(f"the {node.tag} has no variable or expression")
        return parse_expression(self.standard(text), node.pos)

    def _variable(self, node: Node, text: str) -> t.Ref:
        found = self._parsed(node, text)
        if not isinstance(found, t.Ref):
            raise node.error(f"{text} is not a variable")
        return found

    def _flow(self, node: Node, pin: Pin | None) -> t.Expr:
        """Return the value at an input. Connections that meet there are a wired OR (8.2.3)."""
        if pin is not None and pin.expression:
            return self._parsed(node, pin.expression)
        if pin is None or not pin.links:
            raise node.error(f"the {node.tag} has no connection at its input")
        first, *others = [self._source(node, *link) for link in pin.links]
        for other in others:
            first = t.Binary(node.pos, "OR", first, other)
        return first

    def _source(self, node: Node, source: str, output: str) -> t.Expr:
        other = self.nodes[source]
        if other.tag == "leftPowerRail":
            return t.Literal(node.pos, "TRUE", "TRUE")
        if other.tag in ("contact", "coil"):
            return t.Ref(node.pos, other.id)
        if other.tag == "inOutVariable":
            return self._variable(other, written(other.element))
        if other.tag == "inVariable":
            for attribute in ("edge", "storage"):
                if other.element.attributes.get(attribute, "none") != "none":
                    raise other.unsupported(f"{attribute} of an input variable is not supported")
            return self._negated(other.element, other, self._parsed(other, written(other.element)))
        if other.tag == "block":
            return self._output(node, other, output)
        raise other.unsupported(f"a {other.tag} as the source of a value is not supported")

    def _output(self, node: Node, block: Node, name: str) -> t.Expr:
        outputs = {v.attributes.get("formalParameter", ""): v for v in block.element.inside("outputVariables")}
        main = next((each for each in outputs if each.upper() != "ENO"), "")
        name = name or main
        passed = next((p for p in block.pins if p.name == name and name not in outputs), None)
        if passed is not None:  # a VAR_IN_OUT on the right side
            return self._flow(block, passed)
        if name.upper() == "ENO":
            found: t.Expr = t.Ref(node.pos, f"{block.id}.eno")
        elif block.is_instance:
            instance = self._instance(block)
            found = t.Ref(node.pos, instance.name, (*instance.selectors, t.Member(node.pos, name)))
        elif name == main:
            found = t.Ref(node.pos, block.id)
        else:
            raise block.unsupported(f"the output {name} of a function is not supported; its result is {main}")
        return self._negated(outputs[name], node, found) if name in outputs else found

    def _instance(self, block: Node) -> t.Ref:
        return self._variable(block, block.element.attributes["instanceName"])

    def _negated(self, element: Element, node: Node, value: t.Expr) -> t.Expr:
        return t.Unary(node.pos, "NOT", value) if element.attributes.get("negated") == "true" else value

    def _modified(self, element: Element, node: Node, value: t.Expr, name: str = "") -> t.Expr:
        """Return `value` with the negation or the edge detection that the element has."""
        value = self._negated(element, node, value)
        kind = _EDGES.get(element.attributes.get("edge", ""))
        if kind is None:
            return value
        instance = "_".join(part for part in (node.id, "edge", name.lower(), self.suffix) if part)
        self.edges.append(t.VarDecl(node.pos, instance, t.NamedType(node.pos, kind), None))
        call = t.Call(node.pos, t.Ref(node.pos, instance), (t.Argument(node.pos, "CLK", value),))
        self.out.append(t.CallStatement(node.pos, call))
        return t.Ref(node.pos, instance, (t.Member(node.pos, "Q"),))

    # -- elements -------------------------------------------------------------------------------------------------------

    def _contact(self, node: Node) -> None:
        flow = self._flow(node, next(iter(node.pins), None))
        value = self._modified(node.element, node, self._parsed(node, _named(node)))
        if not isinstance(flow, t.Literal):
            value = t.Binary(node.pos, "AND", flow, value)
        self.out.append(t.Hold(node.pos, node.id, value, "a contact"))

    def _coil(self, node: Node) -> None:
        self.out.append(t.Hold(node.pos, node.id, self._flow(node, next(iter(node.pins), None)), "a coil"))
        self._assign(node, _named(node), t.Ref(node.pos, node.id))

    def _outvariable(self, node: Node) -> None:
        pin = next(iter(node.pins), None)
        value = self._flow(node, pin)
        before = len(self.out)
        self._assign(node, written(node.element), value)
        self._only_if_enabled(node, pin, before)

    def _inoutvariable(self, node: Node) -> None:
        for pin in node.pins:
            if pin.links:
                before = len(self.out)
                self._assign(node, written(node.element), self._flow(node, pin))
                self._only_if_enabled(node, pin, before)

    def _only_if_enabled(self, node: Node, pin: Pin | None, before: int) -> None:
        """Keep the variable at the result of a function with EN while the function is not executed."""
        for source, _ in pin.links if pin is not None else ():
            if self.nodes[source].tag == "block" and not self.nodes[source].is_instance and _en(self.nodes[source]):
                inside = tuple(self.out[before:])
                del self.out[before:]
                self.out.append(t.If(node.pos, ((t.Ref(node.pos, f"{source}.eno"), inside),)))
                return

    def _return(self, node: Node) -> None:
        self._leave(node, t.Jump(node.pos, "RETURN"))

    def _jump(self, node: Node) -> None:
        label = node.element.attributes.get("label", "").strip()
        if label.lower() not in self.labels:
            raise node.error(f"a jump to the label {label!r}, which the body does not have")
        self._leave(node, t.Jump(node.pos, "JMP", label))

    def _leave(self, node: Node, jump: t.Jump) -> None:
        """Write a jump or return. Without an input it is unconditional."""
        if not node.pins:
            self.out.append(jump)
            return
        flow = self._negated(node.element, node, self._flow(node, node.pins[0]))
        self.out.append(t.If(node.pos, ((flow, (jump,)),)))

    def _assign(self, node: Node, text: str, value: t.Expr) -> None:
        target = self._variable(node, text)
        value = self._modified(node.element, node, value)
        storage = node.element.attributes.get("storage", "none")
        if storage in ("set", "reset"):
            word = "TRUE" if storage == "set" else "FALSE"
            assign = t.Assign(node.pos, target, t.Literal(node.pos, word, word))
            self.out.append(t.If(node.pos, ((value, (assign,)),)))
        else:
            self.out.append(t.Assign(node.pos, target, value))

    def _block(self, node: Node) -> None:
        enabled = self._enabled(node)
        arguments = tuple(
            t.Argument(node.pos, pin.name, self._modified(pin.element, node, self._flow(node, pin), pin.name))
            for pin in node.pins
            if pin.name.upper() != "EN" and (pin.links or pin.expression)
        )
        if node.is_instance:
            call = t.CallStatement(node.pos, t.Call(node.pos, self._instance(node), arguments))
            self.out.append(call if enabled is None else t.If(node.pos, ((enabled, (call,)),)))
        else:
            self._function(node, arguments, enabled)
        for variable in node.element.inside("outputVariables"):
            point = variable.find("connectionPointOut")
            if point is not None and written(point):
                value = self._output(node, node, variable.attributes.get("formalParameter", ""))
                assign = t.Assign(node.pos, self._variable(node, written(point)), value)
                self.out.append(assign if enabled is None else t.If(node.pos, ((enabled, (assign,)),)))

    def _enabled(self, node: Node) -> t.Expr | None:
        """Write the state of EN, which is also that of ENO; None if the block is always executed."""
        en = _en(node)
        eno = t.Ref(node.pos, f"{node.id}.eno")
        if en is not None:
            self.out.append(t.Hold(node.pos, eno.name, self._flow(node, en), "EN"))
            return eno
        if any(
            v.attributes.get("formalParameter", "").upper() == "ENO" for v in node.element.inside("outputVariables")
        ):
            self.out.append(t.Hold(node.pos, eno.name, t.Literal(node.pos, "TRUE", "TRUE"), "ENO"))
        return None

    def _function(self, node: Node, arguments: tuple[t.Argument, ...], enabled: t.Expr | None) -> None:
        name = node.element.attributes.get("typeName", "")
        if not name.isidentifier():
            raise node.error(f"a block without a usable typeName: {name!r}")
        value: t.Expr = t.Call(node.pos, t.Ref(node.pos, name), arguments)
        if name.upper() == "NOT" and len(arguments) == 1 and arguments[0].value is not None:
            value = t.Unary(node.pos, "NOT", arguments[0].value)
        self.out.append(t.Hold(node.pos, node.id, value, "", enabled))


def _named(node: Node) -> str:
    """Return the variable of a contact or coil."""
    variable = node.element.find("variable")
    return "".join(text for _, text in variable.texts()).strip() if variable is not None else ""


def _en(node: Node) -> Pin | None:
    return next((pin for pin in node.pins if pin.name.upper() == "EN" and (pin.links or pin.expression)), None)
