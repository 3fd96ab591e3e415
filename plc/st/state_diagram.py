"""The state machines of Structured Text: sequential function charts, and each CASE over a variable that its branches assign.

The states of a CASE are the values of the enumeration, or the labels if the variable is a number. An assignment of a state in
a branch is a transition; its label is the condition of the IF, ELSIF or CASE around it. An assignment outside of the CASE leaves
every other state. Bodies of actions count where they are called. This module resolves names only as far as states need
it, so a unit should be compiled first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from fieldtwin.plc.st.charts.check import charts_of
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.written import case_label, reference, text_of
from fieldtwin.plc.states import Transition

OTHER = "(other)"
"""The state that stands for all numbers without a label, if the ELSE of a CASE over a number assigns the variable."""
LONGEST_LABEL = 48
"""A longer condition is cut, so that a diagram stays readable; in characters."""


@dataclass(frozen=True, slots=True)
class StateDiagram:
    """A state machine of a POU: the `variable` that holds the state ("" for a chart), its states, and the transitions in textual
    order.

    `computed` are the places of assignments whose next state is not a constant, so that no transition shows them.
    """

    pou: str
    variable: str
    states: tuple[str, ...]
    initial: str
    transitions: tuple[Transition, ...]
    computed: tuple[t.Pos, ...] = ()
    action: str = ""
    """The action whose body is the chart; "" for the body of the POU."""

    def leaving(self, state: str) -> list[Transition]:
        """Return the transitions that begin in `state`, in textual order."""
        return [transition for transition in self.transitions if transition.source == state]


@dataclass(frozen=True, slots=True)
class StateAssignment:
    """An assignment of the state `target` that leaves one of the states `sources`."""

    pou: str
    variable: str
    sources: tuple[str, ...]
    target: str
    pos: t.Pos


def state_diagrams(unit: t.SourceUnit) -> Iterator[StateDiagram]:
    """Return the state machines of all POUs in the order of the unit, and within a POU in the order of their first CASE."""
    for pou, found in _machines(unit):
        yield found.diagram() if isinstance(found, _Machine) else _chart(pou.name, *found)


def state_assignments(unit: t.SourceUnit) -> Iterator[StateAssignment]:
    """Return the assignments of states that are transitions of a CASE. Charts have none."""
    for _, found in _machines(unit):
        if isinstance(found, _Machine):
            yield from found.assignments()


def _machines(unit: t.SourceUnit) -> Iterator[tuple[t.Pou, tuple[str, t.Chart] | _Machine]]:
    """Return the charts, each with its action, and the state machines of CASEs, of all POUs."""
    enums = {declared.name.lower(): declared for declared in unit.types if isinstance(declared, t.EnumDecl)}
    globals_ = {v.name.lower(): v for block in unit.globals for v in block.variables}
    for pou in unit.pous:
        for action, chart in charts_of(pou).items():
            yield pou, (action, chart)
        own = {v.name.lower(): v for block in pou.blocks for v in block.variables}
        bodies = [pou.body, *(action.body for action in pou.actions)]
        cases = [case for body in bodies for case in _cases(body)]
        for name in dict.fromkeys(name for case in cases if (name := _variable(case.selector))):
            declared = own.get(name) or globals_.get(name)
            found = _Machine(pou, name, declared, enums, [c for c in cases if _variable(c.selector) == name])
            if found.search():
                yield pou, found


def _chart(pou: str, action: str, chart: t.Chart) -> StateDiagram:
    """Return a chart. A transition between several steps is an arrow from each of its sources to each of its targets."""
    names = {step.name.lower(): step.name for step in chart.steps}
    transitions = [
        Transition(names[source.lower()], names[target.lower()], _cut(text_of(one.condition)))
        for one in chart.transitions
        for source in one.sources
        for target in one.targets
    ]
    initial = next(step.name for step in chart.steps if step.initial)
    return StateDiagram(pou, "", tuple(names.values()), initial, tuple(transitions), action=action)


def _cut(label: str) -> str:
    return label if len(label) <= LONGEST_LABEL else f"{label[: LONGEST_LABEL - 1]}…"


def _variable(expr: t.Expr) -> str:
    """Return the name of a variable in lower case; "" for every other expression."""
    return expr.name.lower() if isinstance(expr, t.Ref) and not expr.selectors else ""


def _cases(body: Sequence[t.Statement]) -> Iterator[t.Case]:
    """Return every CASE of a body, the outer ones first."""
    for statement in body:
        if isinstance(statement, t.Case):
            yield statement
        for _, inner in _parts(statement):
            yield from _cases(inner)


def _parts(statement: t.Statement) -> Iterator[tuple[str, tuple[t.Statement, ...]]]:
    """Return the bodies in a statement, each with the condition under which it runs."""
    if isinstance(statement, t.If):
        yield from ((text_of(condition), body) for condition, body in statement.branches)
        yield "else", statement.otherwise
    elif isinstance(statement, t.Case):
        selector = text_of(statement.selector)
        for labels, body in statement.branches:
            yield f"{selector} = {', '.join(map(case_label, labels))}", body
        yield "else", statement.otherwise
    elif isinstance(statement, t.For | t.While | t.Repeat | t.Networks):
        yield "", statement.body


@dataclass
class _Machine:
    """The search for the transitions of one variable, whose name is in lower case."""

    pou: t.Pou
    name: str
    declared: t.VarDecl | None
    enums: dict[str, t.EnumDecl]
    cases: list[t.Case]
    states: dict[str, str] = field(default_factory=dict)
    """The states by their names in lower case."""
    found: list[tuple[tuple[str, ...] | None, str, str, t.Pos]] = field(default_factory=list)
    """Sources (None: every other state), target, condition and place of each transition."""
    computed: list[t.Pos] = field(default_factory=list)
    _calling: list[str] = field(default_factory=list)

    def search(self) -> bool:
        """Search the bodies of the POU. Return whether a branch assigns a state."""
        enum = self._enum()
        names = [value for value, _ in enum.values] if enum else []
        labels = [self._state_name(label) for case in self.cases for each, _ in case.branches for label in each]
        self.states = {name.lower(): name for name in [*names, *labels]}
        self._walk(self.pou.body, None, ())
        return any(sources for sources, _, _, _ in self.found)

    def diagram(self) -> StateDiagram:
        """Return the state machine that `search` has found."""
        transitions = [
            Transition(source, target, when)
            for sources, target, when, _ in self.found
            for source in self._sources(sources, target)
        ]
        initial = self._initial(self._enum())
        return StateDiagram(
            self.pou.name, self._variable_name(), self._all_states(), initial, tuple(dict.fromkeys(transitions)),
            tuple(self.computed),
        )  # fmt: skip

    def assignments(self) -> Iterator[StateAssignment]:
        """Return the assignments that `search` has found."""
        for sources, target, _, pos in self.found:
            yield StateAssignment(self.pou.name, self._variable_name(), self._sources(sources, target), target, pos)

    def _sources(self, sources: tuple[str, ...] | None, target: str) -> tuple[str, ...]:
        return sources if sources is not None else tuple(state for state in self._all_states() if state != target)

    def _all_states(self) -> tuple[str, ...]:
        other = any(OTHER in (sources or ()) for sources, _, _, _ in self.found)
        return (*self.states.values(), OTHER) if other else tuple(self.states.values())

    def _variable_name(self) -> str:
        return self.declared.name if self.declared else self.name

    def _enum(self) -> t.EnumDecl | None:
        kind = self.declared.type if self.declared else None
        return self.enums.get(kind.name.lower()) if isinstance(kind, t.NamedType) else None

    def _initial(self, enum: t.EnumDecl | None) -> str:
        for given in (self.declared.initial if self.declared else None, enum.initial if enum else None):
            if given is not None and (state := self._state(given)):
                return state
        if enum is None and "0" in self.states:
            return self.states["0"]
        return next(iter(self.states.values()))

    def _state_name(self, label: t.CaseLabel) -> str:
        return case_label(label).rpartition("#")[2].rpartition(".")[2] if label.high is None else case_label(label)

    def _state(self, value: t.Init) -> str | None:
        """Return the state that an expression names; None if it is computed."""
        if isinstance(value, t.Literal):
            return self.states.get(value.text.rpartition("#")[2].lower())
        if isinstance(value, t.Ref):
            return self.states.get(reference(value).rpartition(".")[2].lower())
        return None

    def _walk(self, body: Sequence[t.Statement], sources: tuple[str, ...] | None, conditions: tuple[str, ...]) -> None:
        for statement in body:
            if isinstance(statement, t.Assign) and _variable(statement.target) == self.name:
                self._assigned(statement, sources, conditions)
            elif isinstance(statement, t.Case) and _variable(statement.selector) == self.name:
                self._walk_states(statement, conditions)
            elif isinstance(statement, t.CallStatement):
                self._called(statement.call, sources, conditions)
            else:
                for condition, inner in _parts(statement):
                    self._walk(inner, sources, (*conditions, condition) if condition else conditions)

    def _walk_states(self, case: t.Case, conditions: tuple[str, ...]) -> None:
        labelled: set[str] = set()
        for labels, body in case.branches:
            sources = tuple(self.states[self._state_name(label).lower()] for label in labels)
            labelled.update(sources)
            self._walk(body, sources, conditions)
        others = tuple(state for state in self.states.values() if state not in labelled)
        self._walk(case.otherwise, others or (OTHER,), conditions)

    def _assigned(self, statement: t.Assign, sources: tuple[str, ...] | None, conditions: tuple[str, ...]) -> None:
        target = self._state(statement.value)
        if target is None:
            self.computed.append(statement.pos)
            return
        self.found.append((sources, target, _cut(" AND ".join(conditions)), statement.pos))

    def _called(self, call: t.Call, sources: tuple[str, ...] | None, conditions: tuple[str, ...]) -> None:
        """Follow the call of an action of the POU, and note a call that can change the variable."""
        for argument in call.arguments:
            if argument.target is not None and _variable(argument.target) == self.name:
                self.computed.append(argument.pos)
        action = next((a for a in self.pou.actions if a.name.lower() == call.ref.name.lower()), None)
        if action is not None and not call.ref.selectors and action.name not in self._calling:
            self._calling.append(action.name)
            self._walk(action.body, sources, conditions)
            self._calling.pop()
