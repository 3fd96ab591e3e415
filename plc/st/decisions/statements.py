"""The statements that assign variables of a PROGRAM, outputs of function blocks, elements of arrays and members of structures,
each with the conditions under which it is executed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.source import shortened
from fieldtwin.plc.st.syntax.walk import nodes
from fieldtwin.plc.st.syntax.written import case_label, reference, text_of

MAX_VARIABLES = 16
"""The largest number of variables that are recorded for one statement."""
_ANY = "*"
"""In a set of changed variables: every variable may have changed."""


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
class Read:
    """A variable that a decision reads. `doubtful` names a variable in its indices that may have changed between the condition,
    in which it was read, and the statement.
    """

    ref: t.Ref
    doubtful: str = ""

    @property
    def path(self) -> str:
        return reference(self.ref)


@dataclass(frozen=True, slots=True)
class Decision:
    """A statement that assigns a variable, with the conditions around it, the outer ones first.

    `reads` are the variables in the conditions and in the assigned value. `source` is the output of a block that a call assigns
    to the variable, such as ``pump.run``; None for an assignment. `pou` contains the statement, in lower case.
    """

    statement: t.Assign | t.CallStatement
    conditions: tuple[Condition, ...]
    reads: tuple[Read, ...]
    source: t.Ref | None
    pou: str

    @property
    def text(self) -> str:
        one = self.statement
        if isinstance(one, t.CallStatement):
            return _text(one.call)
        return f"{reference(one.target)} := {_text(one.value)}"


DecisionKey = tuple[str, int, str]
"""A file, a line, and an assigned variable in lower case."""
_Assignment = t.Assign | t.CallStatement


class Found(NamedTuple):
    """A statement that assigns variables, with what is around it. `changed` are the variables that may have changed since the
    conditions were evaluated, in lower case.
    """

    statement: _Assignment
    conditions: tuple[Condition, ...]
    read: tuple[t.Expr, ...]
    changed: frozenset[str]
    pou: str


def decisions_of(unit: t.SourceUnit) -> Decisions:
    """Return the statements of the POUs of a unit that assign a variable.

    Nothing is computed before the first statement is looked up, and then only what all statements need.
    """
    return Decisions(unit)


class Decisions(Mapping[DecisionKey, Decision]):
    """The decisions of a unit, each of which is made when it is looked up. Of several statements in one line that assign a
    variable, the last one counts.
    """

    def __init__(self, unit: t.SourceUnit, made: Mapping[DecisionKey, Decision] | None = None) -> None:
        """`made` are all decisions, if another process has made them."""
        self._unit = unit
        self._made = dict(made or {})

    @cached_property
    def _found(self) -> Mapping[DecisionKey, Found | Decision]:
        return self._made.copy() if self._made else self._searched()

    def _searched(self) -> dict[DecisionKey, Found]:
        found: dict[DecisionKey, Found] = {}
        for pou in self._unit.pous:
            key = pou.name.lower()
            bodies = [(key, pou.body), *((key, one.body) for one in pou.actions)]
            bodies += [(f"{key}.{one.name.lower()}", one.body) for one in pou.methods]
            own = frozenset(v.name.lower() for block in pou.blocks for v in block.variables)
            for name, body in bodies if pou.kind != "INTERFACE" else ():
                for one in _Statements(own, name).of(body, (), (), frozenset()):
                    for target in _targets(one.statement):
                        found[one.statement.pos.path, one.statement.pos.line, target] = one
        return found

    @cached_property
    def _lines(self) -> dict[tuple[str, int], list[DecisionKey]]:
        found: dict[tuple[str, int], list[DecisionKey]] = {}
        for key in self._found:
            found.setdefault(key[:2], []).append(key)
        return found

    def at(self, path: str, line: int, names: Iterable[str]) -> Decision | None:
        """Return the decision in a line for the first of these variables that has one; without a statement for one of them, the
        only one in the line, which may assign the variable through a reference. None for none or several.
        """
        key = next((key for name in names if (key := (path, line, name.lower())) in self._found), None)
        if key is not None:
            return self[key]
        keys = self._lines.get((path, line), [])
        return self[keys[0]] if len({self._found[each].statement.pos for each in keys}) == 1 else None

    def __getitem__(self, key: DecisionKey) -> Decision:
        if key not in self._made:
            found = self._found[key]
            self._made[key] = _decision(found, key[2]) if isinstance(found, Found) else found
        return self._made[key]

    def __iter__(self) -> Iterator[DecisionKey]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)


class _Statements:
    """The assignments and calls in a body of a POU whose variables are `own`, in lower case."""

    def __init__(self, own: frozenset[str], pou: str) -> None:
        self._own, self._pou = own, pou

    def of(
        self,
        body: Sequence[t.Statement],
        conditions: tuple[Condition, ...],
        read: tuple[t.Expr, ...],
        changed: frozenset[str],
    ) -> Iterator[Found]:
        """Yield each assignment and call, with the conditions around it, and the expressions of these conditions."""
        for statement in body:
            if isinstance(statement, t.Assign | t.CallStatement):
                yield Found(statement, conditions, read, changed, self._pou)
            elif isinstance(statement, t.If):
                before, expressions = conditions, read
                for condition, inner in statement.branches:
                    line, expressions = condition.pos.line, (*expressions, condition)
                    yield from self.of(inner, (*before, Condition(line, condition, True)), expressions, changed)
                    before = (*before, Condition(line, condition, False))
                yield from self.of(statement.otherwise, before, expressions, changed)
            elif isinstance(statement, t.Case):
                yield from self._case(statement, conditions, (*read, statement.selector), changed)
            elif isinstance(statement, t.For | t.While | t.Repeat | t.Networks):
                inside = changed | self._changed(statement) if conditions else changed
                yield from self.of(statement.body, conditions, read, inside)
            if conditions:
                changed |= self._changed(statement)

    def _case(
        self, case: t.Case, conditions: tuple[Condition, ...], read: tuple[t.Expr, ...], changed: frozenset[str]
    ) -> Iterator[Found]:
        for labels, inner in case.branches:
            taken = Condition(labels[0].pos.line, case.selector, True, labels)
            yield from self.of(inner, (*conditions, taken), read, changed)
        every = tuple(label for labels, _ in case.branches for label in labels)
        other = Condition(case.pos.line, case.selector, False, every)
        yield from self.of(case.otherwise, (*conditions, other), read, changed)

    def _changed(self, statement: t.Statement) -> frozenset[str]:
        """Return the variables that a statement may change, in lower case, or `_ANY`."""
        found: set[str] = set()
        for node in nodes(statement):
            if isinstance(node, t.Assign):
                through = any(isinstance(s, t.Deref) for s in node.target.selectors)
                found.add(_ANY if through else node.target.name.lower())
            elif isinstance(node, t.For):
                found.add(node.variable.name.lower())
            elif isinstance(node, t.Argument):
                passed = node.target or node.value
                found |= {passed.name.lower()} if isinstance(passed, t.Ref) else set()
            elif isinstance(node, t.CallStatement):
                called = node.call.ref
                found |= {_ANY} if called.selectors or called.name.lower() not in self._own else set()
        return frozenset(found)


def _targets(statement: _Assignment) -> Iterator[str]:
    """Yield the variables that a statement assigns, in lower case."""
    if isinstance(statement, t.Assign):
        yield statement.target.name.lower()
        return
    for argument in statement.call.arguments:
        passed = argument.target or argument.value  # the value may be a VAR_IN_OUT
        if isinstance(passed, t.Call) and passed.ref.name.upper() == "ADR":  # memory that is written
            passed = passed.arguments[0].value if passed.arguments else None
        if isinstance(passed, t.Ref):
            yield passed.name.lower()


def _decision(found: Found, target: str) -> Decision:
    """Return the decision of a statement that assigns the variable `target`, in lower case."""
    statement, source = found.statement, None
    values: list[object]
    if isinstance(statement, t.Assign):
        values = [statement.value, *(s for s in statement.target.selectors if isinstance(s, t.Index))]
    else:
        call = statement.call
        values = [one.value for one in call.arguments if one.value is not None]
        output = next((one for one in call.arguments if one.target and one.target.name.lower() == target), None)
        if output is not None:
            source = replace(call.ref, selectors=(*call.ref.selectors, t.Member(output.pos, output.name)))
    reads = [Read(ref, _doubtful(ref, found.changed)) for ref in references(found.read)]
    reads += [Read(ref) for ref in references(values)]
    by_path = {one.path: one for one in reversed(reads)}
    unique = tuple(by_path[path] for path in dict.fromkeys(one.path for one in reads))
    return Decision(statement, found.conditions, unique[:MAX_VARIABLES], source, found.pou)


def _doubtful(ref: t.Ref, changed: frozenset[str]) -> str:
    """Return the first variable in the indices of `ref` that is among the `changed` ones; empty for none."""
    names = [one.name for one in references([s for s in ref.selectors if isinstance(s, t.Index)])]
    return next((name for name in names if name.lower() in changed or _ANY in changed), "")


def references(expressions: Sequence[object]) -> list[t.Ref]:
    """Return the variables in expressions, in the order of the source."""
    called = {id(node.ref) for node in nodes(tuple(expressions)) if isinstance(node, t.Call)}
    found = [node for node in nodes(tuple(expressions)) if isinstance(node, t.Ref) and id(node) not in called]
    return sorted(found, key=lambda ref: (ref.pos.line, ref.pos.column))


def _text(expression: t.Expr) -> str:
    try:
        return shortened(text_of(expression))
    except RecursionError:
        return "(an expression that is nested too deep to be shown)"
