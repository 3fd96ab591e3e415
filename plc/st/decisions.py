"""The statements that assign variables of a PROGRAM and outputs of function blocks, each with the conditions under which it is
executed.

So `fieldtwin plc why` can show which statement gave a tag its value, also inside the function blocks that the program uses, and
what decided that it was executed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Any

import msgspec

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.inspection import Inspection, literal
from fieldtwin.plc.st.runtime.lines import line_of
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.source import shortened
from fieldtwin.plc.st.syntax.walk import nodes
from fieldtwin.plc.st.syntax.written import case_label, reference, text_of

MAX_VARIABLES = 16
"""The largest number of variables that are recorded for one statement."""
MAX_DEPTH = 8
"""How deep instances inside instances are followed."""
MAX_INSIDE = 8
"""The largest number of statements inside function blocks that are recorded for one statement of a program."""


@dataclass(frozen=True, slots=True)
class Condition:
    """A condition around a statement. It `holds`, or it is the one of an earlier branch and does not."""

    line: int
    expression: t.Expr
    holds: bool
    labels: tuple[t.CaseLabel, ...] = ()
    """The labels of the branch, if the expression is the selector of a CASE."""

    @property
    def text(self) -> str:
        labels = f" = {', '.join(map(case_label, self.labels))}" if self.labels else ""
        return _text(self.expression) + labels


@dataclass(frozen=True, slots=True)
class Decision:
    """A statement that assigns a variable, with the conditions around it, the outer ones first.

    `reads` are the paths of the variables in the conditions and in the assigned value. `source` is the path of the output of a
    block that a call assigns to the variable, such as ``pump.run``; empty for an assignment.
    """

    statement: t.Assign | t.CallStatement
    conditions: tuple[Condition, ...]
    reads: tuple[str, ...]
    source: str = ""

    @property
    def text(self) -> str:
        one = self.statement
        if isinstance(one, t.CallStatement):
            return _text(one.call)
        return f"{reference(one.target)} := {_text(one.value)}"


DecisionKey = tuple[str, int, str]
"""A file, a line, and an assigned variable in lower case."""
Decisions = Mapping[DecisionKey, Decision]
"""Of several statements in one line that assign a variable, the last one counts."""
_Assignment = t.Assign | t.CallStatement
_Found = tuple[_Assignment, tuple[Condition, ...], tuple[t.Expr, ...]]


def decisions_of(unit: t.SourceUnit) -> Decisions:
    """Return the statements of the PROGRAMs, function blocks and methods of a unit that assign a variable.

    Nothing is computed before the first statement is looked up, and then only what all statements need.
    """
    return _Lookup(unit)


class _Lookup(Mapping[DecisionKey, Decision]):
    """The decisions of a unit, each of which is made when it is looked up."""

    def __init__(self, unit: t.SourceUnit) -> None:
        self._unit = unit
        self._made: dict[DecisionKey, Decision] = {}

    @cached_property
    def _found(self) -> dict[DecisionKey, _Found]:
        found: dict[DecisionKey, _Found] = {}
        for pou in self._unit.pous:
            bodies = (pou.body, *(one.body for one in pou.actions), *(one.body for one in pou.methods))
            for body in bodies if pou.kind not in ("FUNCTION", "INTERFACE") else ():
                for one in _statements(body, (), ()):
                    for target in _targets(one[0]):
                        found[one[0].pos.path, one[0].pos.line, target] = one
        return found

    def __getitem__(self, key: DecisionKey) -> Decision:
        if key not in self._made:
            self._made[key] = _decision(*self._found[key], key[2])
        return self._made[key]

    def __iter__(self) -> Iterator[DecisionKey]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)


def _statements(
    body: Sequence[t.Statement], conditions: tuple[Condition, ...], read: tuple[t.Expr, ...]
) -> Iterator[_Found]:
    """Yield each assignment and call, with the conditions around it, and the expressions of these conditions."""
    for statement in body:
        if isinstance(statement, t.Assign | t.CallStatement):
            yield statement, conditions, read
        elif isinstance(statement, t.If):
            before, expressions = conditions, read
            for condition, inner in statement.branches:
                line, expressions = condition.pos.line, (*expressions, condition)
                yield from _statements(inner, (*before, Condition(line, condition, True)), expressions)
                before = (*before, Condition(line, condition, False))
            yield from _statements(statement.otherwise, before, expressions)
        elif isinstance(statement, t.Case):
            yield from _case(statement, conditions, (*read, statement.selector))
        elif isinstance(statement, t.For | t.While | t.Repeat):
            yield from _statements(statement.body, conditions, read)


def _case(case: t.Case, conditions: tuple[Condition, ...], read: tuple[t.Expr, ...]) -> Iterator[_Found]:
    for labels, inner in case.branches:
        taken = Condition(labels[0].pos.line, case.selector, True, labels)
        yield from _statements(inner, (*conditions, taken), read)
    every = tuple(label for labels, _ in case.branches for label in labels)
    other = Condition(case.pos.line, case.selector, False, every)
    yield from _statements(case.otherwise, (*conditions, other), read)


def _targets(statement: _Assignment) -> Iterator[str]:
    """Yield the variables that a statement assigns, in lower case."""
    if isinstance(statement, t.Assign):
        yield statement.target.name.lower()
        return
    for argument in statement.call.arguments:
        if argument.target is not None:
            yield argument.target.name.lower()


def _decision(
    statement: _Assignment, conditions: tuple[Condition, ...], read: tuple[t.Expr, ...], target: str
) -> Decision:
    """Return the decision of a statement that assigns the variable `target`, in lower case."""
    source = ""
    if isinstance(statement, t.Assign):
        values = [statement.value]
    else:
        call = statement.call
        values = [one.value for one in call.arguments if one.value is not None]
        output = next(one for one in call.arguments if one.target is not None and one.target.name.lower() == target)
        source = f"{reference(call.ref)}.{output.name}"
    paths = [reference(ref) for ref in _references((*read, *values))]
    return Decision(statement, conditions, tuple(dict.fromkeys(paths))[:MAX_VARIABLES], source)


def _references(expressions: Sequence[t.Expr]) -> list[t.Ref]:
    """Return the variables in expressions, in the order of the source."""
    called = {id(node.ref) for node in nodes(tuple(expressions)) if isinstance(node, t.Call)}
    found = [node for node in nodes(tuple(expressions)) if isinstance(node, t.Ref) and id(node) not in called]
    return sorted(found, key=lambda ref: (ref.pos.line, ref.pos.column))


def _text(expression: t.Expr) -> str:
    try:
        return shortened(text_of(expression))
    except RecursionError:
        return "(an expression that is nested too deep to be shown)"


class DecisionReader:
    """Reads the variables of a decision from a running program. `hidden` are variables in lower case that are not wanted."""

    def __init__(
        self,
        unit: CompiledUnit,
        variables: Sequence[tuple[str, ty.Type]],
        decisions: Decisions,
        hidden: frozenset[str] = frozenset(),
    ) -> None:
        self._unit, self._inspection, self._decisions = unit, Inspection(unit, variables), decisions
        self._hidden = hidden
        self._plans: dict[DecisionKey, _Plan] = {}
        """The decisions that were read."""
        self._blocks: dict[str, DecisionReader] = {}
        """The readers of function blocks by their names in lower case; those of a block are shared by all its instances."""

    def read(self, body: Any, key: DecisionKey) -> Decided | None:
        """Return the decision for a file, a line and a variable, with the present values; None without such a statement.

        The outputs of function blocks that it uses are followed to the statements in these blocks.
        """
        plan = self._plan(key)
        if plan is None:
            return None
        inside = tuple(self._inside(body, plan, "", 0)[:MAX_INSIDE]) if plan.outputs else ()
        return Decided(plan.decision, plan.variables, plan.values_of(body), inside)

    def _inside(self, body: Any, plan: _Plan, at: str, depth: int) -> list[Inside]:
        """Return the statements that assigned the outputs of instances which a statement uses, each before those inside it."""
        found: list[Inside] = []
        for output in plan.outputs if depth < MAX_DEPTH else ():
            instance = output.instance(body)
            place: tuple[str, int] = getattr(instance, line_of(f"v_{output.name}"), None) or ("", 0)
            inner = output.reader._plan((*place, output.name)) if place[1] and len(found) < MAX_INSIDE else None
            if inner is not None:
                path = f"{at}{output.path}"
                values = inner.values_of(instance)
                found.append(Inside(path, output.block, place, Decided(inner.decision, inner.variables, values)))
                found += output.reader._inside(instance, inner, f"{path}.", depth + 1)
        return found

    def _plan(self, key: DecisionKey) -> _Plan | None:
        plan = self._plans.get(key)
        if plan is None:
            decision = self._decisions.get(key)
            if decision is None:
                return None
            paths = (*decision.reads, *((decision.source,) if decision.source else ()))
            plan = self._plans[key] = _Plan(decision, *self._variables(decision), tuple(self._outputs(paths)))
        return plan

    def _variables(self, decision: Decision) -> tuple[_Variables, _Reader]:
        shown = [path for path in decision.reads if path.partition(".")[0].lower() not in self._hidden]
        found = [(path, *attribute) for path in shown if (attribute := self._inspection.attribute(path)) is not None]
        return tuple([(path, kind) for path, _, kind in found]), reader([attribute for _, attribute, _ in found])

    def _outputs(self, paths: Sequence[str]) -> Iterator[_Output]:
        """Yield the outputs of instances of function blocks among `paths`."""
        for path in dict.fromkeys(paths):
            instance, _, name = path.rpartition(".")
            found = self._inspection.instance(instance) if instance else None
            if found is None:
                continue
            attribute, block = found
            key = block.name.lower()
            if key not in self._blocks:
                reader_of_block = DecisionReader(self._unit, self._unit.blocks[key], self._decisions)
                reader_of_block._blocks = self._blocks
                self._blocks[key] = reader_of_block
            yield _Output(instance, name.lower(), block.name, attrgetter(attribute), self._blocks[key])


def reader(attributes: list[str]) -> _Reader:
    """Return a function that reads these attributes of an object, with one call for all of them."""
    if len(attributes) > 1:
        return attrgetter(*attributes)
    each = [attrgetter(attribute) for attribute in attributes]
    return lambda body: tuple([read(body) for read in each])


_Variables = tuple[tuple[str, ty.Type], ...]
"""The paths and types of variables."""
_Reader = Callable[[Any], tuple[Any, ...]]
"""A function that returns the values of some attributes of an object."""


@dataclass(frozen=True, slots=True)
class _Output:
    """The output `name` of an instance at `path`, in lower case, with the reader of its block."""

    path: str
    name: str
    block: str
    instance: Callable[[Any], Any]
    reader: DecisionReader


@dataclass(frozen=True, slots=True)
class _Plan:
    """A decision, with its variables, the function that reads these, and the outputs of instances that are followed."""

    decision: Decision
    variables: _Variables
    values_of: _Reader
    outputs: tuple[_Output, ...]


class Decided(msgspec.Struct, frozen=True, gc=False):
    """An executed decision, with the values of its variables after the scan, and the statements inside the function blocks whose
    outputs it used, the outer blocks first.
    """

    decision: Decision
    variables: _Variables
    values: tuple[Any, ...]
    inside: tuple[Inside, ...] = ()

    def describe(self) -> dict[str, Any]:
        """Return data for JSON."""
        found: dict[str, Any] = {
            "statement": self.decision.text,
            "conditions": [
                {"line": one.line, "text": one.text, "holds": one.holds} for one in self.decision.conditions
            ],
            "variables": {
                path: literal(kind, value) for (path, kind), value in zip(self.variables, self.values, strict=True)
            },
        }
        return {**found, "inside": [one.describe() for one in self.inside]} if self.inside else found


class Inside(msgspec.Struct, frozen=True, gc=False):
    """The statement inside a function block that assigned an output of the instance `path`, such as ``pump.starter``.

    `place` is its file and line.
    """

    path: str
    block: str
    place: tuple[str, int]
    decided: Decided

    def describe(self) -> dict[str, Any]:
        """Return data for JSON."""
        place = ":".join(map(str, self.place))
        return {"instance": self.path, "block": self.block, "place": place, **self.decided.describe()}
