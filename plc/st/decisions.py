"""The statements of a PROGRAM that assign its variables, each with the conditions under which it is executed.

So `fieldtwin plc why` can show which statement gave a tag its value, and what decided that it was executed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import msgspec

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.inspection import Inspection, literal
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.source import shortened
from fieldtwin.plc.st.syntax.walk import nodes
from fieldtwin.plc.st.syntax.written import case_label, reference, text_of

MAX_VARIABLES = 16
"""The largest number of variables that are recorded for one statement."""


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

    `reads` are the paths of the variables in the conditions and in the assigned value.
    """

    statement: t.Assign | t.CallStatement
    conditions: tuple[Condition, ...]
    reads: tuple[str, ...]

    @property
    def text(self) -> str:
        one = self.statement
        if isinstance(one, t.CallStatement):
            return _text(one.call)
        return f"{reference(one.target)} := {_text(one.value)}"


Decisions = Mapping[tuple[str, int, str], Decision]
"""By file, line and assigned variable in lower case. Of several statements in one line the last one counts."""


def decisions_of(unit: t.SourceUnit) -> Decisions:
    """Return the statements of the PROGRAMs of a unit that assign a variable, without those of function blocks."""
    found: dict[tuple[str, int, str], Decision] = {}
    for pou in unit.pous:
        for body in (pou.body, *(action.body for action in pou.actions)) if pou.kind == "PROGRAM" else ():
            for statement, conditions, read in _statements(body, (), ()):
                _add(found, statement, conditions, read)
    return found


_Found = tuple[t.Assign | t.CallStatement, tuple[Condition, ...], tuple[t.Expr, ...]]


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


def _add(
    found: dict[tuple[str, int, str], Decision],
    statement: t.Assign | t.CallStatement,
    conditions: tuple[Condition, ...],
    read: tuple[t.Expr, ...],
) -> None:
    if isinstance(statement, t.Assign):
        targets, values = [statement.target], [statement.value]
    else:
        arguments = statement.call.arguments
        targets = [a.target for a in arguments if a.target is not None]
        values = [a.value for a in arguments if a.value is not None]
    paths = [reference(ref) for ref in _references((*read, *values))]
    pos = statement.pos
    decision = Decision(statement, conditions, tuple(dict.fromkeys(paths))[:MAX_VARIABLES])
    for target in targets:
        found[pos.path, pos.line, target.name.lower()] = decision


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

    def __init__(self, inspection: Inspection, decisions: Decisions, hidden: frozenset[str]) -> None:
        self._inspection, self._decisions, self._hidden = inspection, decisions, hidden
        self._found: dict[tuple[str, int, str], tuple[Decision, _Variables, _Reader]] = {}
        """The decisions that were read, with their variables, and the function that reads these from a program."""

    def read(self, body: Any, key: tuple[str, int, str]) -> Decided | None:
        """Return the decision for a file, a line and a variable, with the present values; None without such a statement."""
        found = self._found.get(key)
        if found is None:
            decision = self._decisions.get(key)
            if decision is None:
                return None
            found = self._found[key] = (decision, *self._variables(decision))
        decision, variables, values_of = found
        return Decided(decision, variables, values_of(body))

    def _variables(self, decision: Decision) -> tuple[_Variables, _Reader]:
        shown = [path for path in decision.reads if path.partition(".")[0].lower() not in self._hidden]
        found = [(path, *attribute) for path in shown if (attribute := self._inspection.attribute(path)) is not None]
        return tuple([(path, kind) for path, _, kind in found]), reader([attribute for _, attribute, _ in found])


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


class Decided(msgspec.Struct, frozen=True, gc=False):
    """An executed decision, with the values of its variables after the scan."""

    decision: Decision
    variables: _Variables
    values: tuple[Any, ...]

    def describe(self) -> dict[str, Any]:
        """Return data for JSON."""
        return {
            "statement": self.decision.text,
            "conditions": [
                {"line": one.line, "text": one.text, "holds": one.holds} for one in self.decision.conditions
            ],
            "variables": {
                path: literal(kind, value) for (path, kind), value in zip(self.variables, self.values, strict=True)
            },
        }
