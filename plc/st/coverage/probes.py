"""Insert probes into the POUs of a unit: before each statement, in each branch, and at each transition between two states.

A transition is the assignment of a state in a state machine (`fieldtwin.plc.st.state_diagram`), or the clearing of a transition
of a chart.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.coverage.places import Kind, Place
from fieldtwin.plc.st.state_diagram import StateAssignment, state_assignments
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.walk import with_parts

_STATEMENTS = (t.Assign, t.CallStatement, t.If, t.Case, t.For, t.While, t.Repeat, t.Jump)


class Probes:
    """The probes of units, and the places that they stand for."""

    def __init__(self) -> None:
        self._numbers = count(1)
        self._places: dict[int, Place] = {}
        self._states: dict[int, dict[str, Place]] = {}
        """By number of a probe that records a state: the transitions by the name of their source, in lower case."""

    def insert(self, unit: t.SourceUnit, but: Iterable[str]) -> t.SourceUnit:
        """Return `unit` with probes in its POUs, except those of the files `but`."""
        left_out = frozenset(but)
        assigned: dict[str, list[StateAssignment]] = {}
        for one in state_assignments(unit):
            assigned.setdefault(one.pou.lower(), []).append(one)
        pous = (
            pou if pou.pos.path in left_out else self._pou(pou, assigned.get(pou.name.lower(), ())) for pou in unit.pous
        )
        return replace(unit, pous=tuple(pous))

    def result(self, executed: set[Any], probed: Mapping[int, ty.Type]) -> dict[Place, bool]:
        """Return each place, and whether it was executed. `executed` and `probed` are what a run and the compiler recorded."""
        found = {place: number in executed for number, place in self._places.items()}
        for number, transitions in self._states.items():
            kind = probed.get(number)
            values = {one[1] for one in executed if isinstance(one, tuple) and one[0] == number}
            names = {_state_name(kind, value) for value in values}
            for source, place in transitions.items():
                found[place] = found.get(place, False) or source in names
        return found

    def _pou(self, pou: t.Pou, assigned: Sequence[StateAssignment]) -> t.Pou:
        body = _Body(self, pou, assigned)
        return with_parts(pou, body.changed)  # type: ignore[no-any-return]

    def probe(self, kind: Kind, pos: t.Pos, name: str, pou: str) -> t.Probe:
        number = next(self._numbers)
        self._places[number] = _place(kind, pos, name, pou)
        return t.Probe(pos, number)

    def state_probe(self, one: StateAssignment) -> t.Probe:
        """Return the probe of an assignment of a state. If it may leave several states, it records the present one."""
        named = {source: f"{one.pou}.{one.variable} {source} -> {one.target}" for source in one.sources}
        places = {source.lower(): _place(Kind.TRANSITION, one.pos, name, one.pou) for source, name in named.items()}
        number = next(self._numbers)
        if len(places) == 1:
            self._places[number] = next(iter(places.values()))
            return t.Probe(one.pos, number)
        self._states[number] = places
        return t.Probe(one.pos, number, t.Ref(one.pos, one.variable))


class _Body:
    """The insertion of probes into the bodies of one POU."""

    def __init__(self, probes: Probes, pou: t.Pou, assigned: Sequence[StateAssignment]) -> None:
        self._probes, self._pou = probes, pou.name
        self._assigned: dict[t.Pos, list[StateAssignment]] = {}
        for one in assigned:
            self._assigned.setdefault(one.pos, []).append(one)

    def changed(self, node: Any) -> Any:
        if isinstance(node, tuple) and any(isinstance(part, _STATEMENTS) for part in node):
            return tuple(one for statement in node for one in self._statement(statement))
        if isinstance(node, t.Chart):
            return replace(node, transitions=tuple(self._transition(one) for one in node.transitions))
        if isinstance(node, t.If):
            branches = tuple(
                (condition, self._branch(node.pos, f"THEN {n}", body))
                for n, (condition, body) in enumerate(node.branches, 1)
            )
            return replace(node, branches=branches, otherwise=self._branch(node.pos, "ELSE", node.otherwise))
        if isinstance(node, t.Case):
            cases = tuple(
                (labels, self._branch(node.pos, f"branch {n}", body))
                for n, (labels, body) in enumerate(node.branches, 1)
            )
            return replace(node, branches=cases, otherwise=self._branch(node.pos, "ELSE", node.otherwise))
        return with_parts(node, self.changed)

    def _transition(self, one: t.Transition) -> t.Transition:
        name = f"{self._pou} {', '.join(one.sources)} -> {', '.join(one.targets)}"
        probe = self._probes.probe(Kind.TRANSITION, one.pos, name, self._pou)
        return replace(one, probe=probe, body=self.changed(one.body))

    def _statement(self, statement: Any) -> list[Any]:
        found: list[Any] = []
        if isinstance(statement, _STATEMENTS):
            found.append(self._probes.probe(Kind.STATEMENT, statement.pos, "", self._pou))
            found += [self._probes.state_probe(one) for one in self._assigned.get(statement.pos, ())]
        return [*found, self.changed(statement)]

    def _branch(self, pos: t.Pos, name: str, body: tuple[t.Statement, ...]) -> tuple[t.Statement, ...]:
        return (self._probes.probe(Kind.BRANCH, pos, name, self._pou), *self.changed(body))


def _place(kind: Kind, pos: t.Pos, name: str, pou: str) -> Place:
    return Place(pos.path, pos.line, pos.column, kind, name, pou)


def _state_name(kind: ty.Type | None, value: Any) -> str:
    """Return the name of a state in lower case: the enumerated value, or the number."""
    if isinstance(kind, ty.Enum):
        return next((word.lower() for word, number in kind.values.items() if number == value), "")
    return str(value)
