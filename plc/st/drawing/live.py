"""The present values of a drawing, read from a running program: steps, transitions, actions, contacts, coils and wires.

Expressions are evaluated with the values that variables have between two scans. This changes nothing: an expression with a call,
other than of a few functions of the standard, has no value here. Only the parts of one drawing are read at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from operator import add, and_, eq, ge, gt, le, lt, mul, ne, or_, sub, xor
from typing import Any

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.charts.translate import control_of
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.compiler.literals import Malformed, constant
from fieldtwin.plc.st.drawing.drawings import Drawing, drawings_of
from fieldtwin.plc.st.inspection import Inspection, Typed
from fieldtwin.plc.st.state_diagram import StateDiagram, state_diagrams
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.written import reference

MOST_DRAWINGS = 16
"""The largest number of drawings of one program."""
MOST_ELEMENTS = 1_000
"""The largest number of elements of a drawing for displays, because a PLC makes it when it starts: 0.2 s for 800 elements."""
MOST_PARTS = 400
"""The largest number of parts of a drawing whose values are read, because this happens between two scans."""
_STATE = "state"
"""The variable that holds the state of a program, for displays."""
_BINARY: dict[str, Callable[[Any, Any], Any]] = {
    "AND": and_, "&": and_, "OR": or_, "XOR": xor, "=": eq, "<>": ne, "<": lt, ">": gt, "<=": le, ">=": ge,
    "+": add, "-": sub, "*": mul, "AND_THEN": and_, "OR_ELSE": or_,
}  # fmt: skip
_FUNCTIONS: dict[str, Callable[[Any, Any], Any]] = {
    "AND": and_, "OR": or_, "XOR": xor, "EQ": eq, "NE": ne, "LT": lt, "GT": gt, "LE": le, "GE": ge, "ADD": add, "SUB": sub,
    "MUL": mul, "MIN": min, "MAX": max,
}  # fmt: skip


class _UnknownValue(Exception):
    """An expression has no value that can be read."""


@dataclass(frozen=True, slots=True)
class LiveDrawing:
    """A drawing of a program or of one of its function blocks.

    `path` is the instance, "" for the program; `name` is shown to users.
    """

    name: str
    path: str
    pou: t.Pou
    drawing: Drawing
    svg: str
    """The SVG text, which takes its style from the page."""


@dataclass(frozen=True, slots=True)
class Pictures:
    """The pictures of a program for displays: its drawings, and the state machine of its variable `state`, if it has one."""

    drawings: list[LiveDrawing]
    machine: StateDiagram | None


def pictures_of(unit: CompiledUnit, program: str, variables: Sequence[tuple[str, ty.Type]]) -> Pictures:
    """Return the pictures of a PROGRAM, whose `variables` are given with their types. The unit has to have its source."""
    own = (one for one in state_diagrams(unit.source) if one.pou == program)
    machine = next((one for one in own if one.variable.lower() == _STATE), None)
    return Pictures(_live_drawings(unit.source, program, variables, Inspection(unit, variables)), machine)


def _live_drawings(
    unit: t.SourceUnit, program: str, variables: Sequence[tuple[str, ty.Type]], inspection: Inspection
) -> list[LiveDrawing]:
    """Return the drawings of a program and of the function blocks in its `variables`."""
    by_pou: dict[str, list[Drawing]] = {}
    for one in drawings_of(unit):
        by_pou.setdefault(one.pou.lower(), []).append(one)
    if not by_pou:
        return []
    pous = {pou.name.lower(): pou for pou in unit.pous}
    found: list[LiveDrawing] = []
    for path, pou in (("", program.lower()), *_instances(variables, inspection)):
        for one in by_pou.get(pou, ()):
            if len(found) < MOST_DRAWINGS and one.elements <= MOST_ELEMENTS:
                name = ".".join(part for part in (program, path, one.action) if part)
                with suppress(UsageError):  # a chart that cannot be drawn is still executed
                    found.append(LiveDrawing(name, path, pous[pou], one, one.svg(name, style=False)))
    return found


def _instances(
    variables: Sequence[tuple[str, ty.Type]], inspection: Inspection, before: str = "", depth: int = 4
) -> Iterator[tuple[str, str]]:
    """Yield the path and the type, in lower case, of each function block of the user."""
    for name, kind in variables:
        if isinstance(kind, ty.Block) and kind.standard is None and not name[0].isdigit():
            path = f"{before}{name}"
            yield path, kind.name.lower()
            if depth:
                yield from _instances(inspection.variables_of(kind), inspection, f"{path}.", depth - 1)


class Reading:
    """The values of one drawing. `find` returns the type and value of a variable of its POU by its path."""

    def __init__(self, live: LiveDrawing, find: Callable[[str], Typed | None], holder: Any) -> None:
        self._live, self._find, self._holder = live, find, holder
        self._held: dict[str, Any] = {}

    def values(self) -> dict[str, Any]:
        """Return the values as data for JSON, by kind and by the name of the part in the drawing."""
        body = self._live.drawing.body
        return self._chart(body) if isinstance(body, t.Chart) else self._network()

    # -- charts -------------------------------------------------------------------------------------------------------------

    def _chart(self, chart: t.Chart) -> dict[str, Any]:
        steps = {step.name: self._step(step.name) for step in chart.steps[:MOST_PARTS]}
        active = {name.lower() for name, value in steps.items() if value["active"]}
        transitions = {}
        for number, one in enumerate(chart.transitions[:MOST_PARTS]):
            enabled = all(name.lower() in active for name in one.sources)
            transitions[str(number)] = {"enabled": enabled, "true": self.of(one.condition)}
        actions = {one.action: self._action(one.action) for step in chart.steps for one in step.associations}
        return {"steps": steps, "transitions": transitions, "actions": actions}

    def _step(self, name: str) -> dict[str, Any]:
        active, time = (self._find(f"{name}.{member}") for member in ("X", "T"))
        return {
            "active": bool(active is not None and active[1]),
            "time_s": time[1] / 1e9 if time is not None else None,
        }

    def _action(self, name: str) -> bool:
        """Return whether the output Q of the control of an action is TRUE."""
        control = getattr(self._holder, f"v_{control_of(name).lower()}", None)
        return bool(getattr(control, "v_0q", False))

    # -- networks -----------------------------------------------------------------------------------------------------------

    def _network(self) -> dict[str, Any]:
        """Return the values of contacts, coils and results of functions by their localId, and the outputs of blocks."""
        action = self._live.drawing.action
        pou = self._live.pou
        body = next((one.body for one in pou.actions if one.name == action), pou.body) if action else pou.body
        found: dict[str, Any] = {}
        for statement in [one for one in nodes_in_order(body) if isinstance(one, t.Hold)][:MOST_PARTS]:
            self._held[statement.name] = found[statement.name] = self.of(statement.value)
        return {"nodes": found, "wires": dict(self._wires(found))}

    def _wires(self, found: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
        graphic = self._live.drawing.body
        assert isinstance(graphic, t.Graphic)
        for element in graphic.body.children[:MOST_PARTS]:
            local = element.attributes.get("localId", "").strip()
            if element.tag == "leftPowerRail":
                yield f"{local}.", True
            elif element.tag in ("contact", "coil"):
                yield f"{local}.", found.get(local)
            elif element.tag == "inVariable" and element.attributes.get("negated") != "true":
                expression = element.find("expression")
                text = "".join(piece for _, piece in expression.texts()).strip() if expression is not None else ""
                yield f"{local}.", _shown(self._find(text))
            elif element.tag == "block":
                instance = element.attributes.get("instanceName", "")
                main = True
                for variable in element.inside("outputVariables"):
                    pin = variable.attributes.get("formalParameter", "")
                    value = _shown(self._find(f"{instance}.{pin}")) if instance else found.get(local)
                    negated = variable.attributes.get("negated") == "true" and isinstance(value, bool)
                    value = not value if negated else value
                    yield f"{local}.{pin}", value
                    if main and pin.upper() != "ENO":  # a connection without a name begins here
                        yield f"{local}.", value
                        main = False

    # -- expressions --------------------------------------------------------------------------------------------------------

    def of(self, expression: t.Expr) -> Any:
        """Return the value of an expression; None if it cannot be read."""
        try:
            value = self._value(expression)
        except (_UnknownValue, TypeError, ValueError, ArithmeticError, RecursionError, Malformed):
            return None
        return value if isinstance(value, bool | int | float | str) else None

    def _value(self, one: t.Expr) -> Any:
        if isinstance(one, t.Literal):
            return self._literal(one)
        if isinstance(one, t.Ref):
            if one.name in self._held and not one.selectors:
                return self._known(self._held[one.name])
            found = self._find(reference(one))
            return self._known(found[1] if found is not None else None)
        if isinstance(one, t.Unary):
            value = self._value(one.operand)
            if one.op.upper() == "NOT" and isinstance(value, bool):
                return not value
            return -value if one.op == "-" else self._known(None)
        if isinstance(one, t.Binary) and one.op.upper() in _BINARY:
            return _BINARY[one.op.upper()](self._value(one.left), self._value(one.right))
        if isinstance(one, t.Call) and one.ref.name.upper() in _FUNCTIONS and not one.ref.selectors:
            first, *rest = [self._value(a.value) for a in one.arguments if a.value is not None]
            for value in rest:
                first = _FUNCTIONS[one.ref.name.upper()](first, value)
            return first
        raise _UnknownValue

    def _literal(self, one: t.Literal) -> Any:
        return constant(one).value

    def _known(self, value: Any) -> Any:
        if value is None:
            raise _UnknownValue
        return value


def nodes_in_order(body: Sequence[t.Statement]) -> Iterator[t.Statement]:
    """Yield the statements of a drawn body in their order, also those inside an IF."""
    for one in body:
        yield one
        if isinstance(one, t.If):
            for _, inner in one.branches:
                yield from nodes_in_order(inner)
        elif isinstance(one, t.Networks):
            yield from nodes_in_order(one.body)


def _shown(found: Typed | None) -> Any:
    return found[1] if found is not None and isinstance(found[1], bool | int | float | str) else None
