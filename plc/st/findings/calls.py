"""Instances of timers, edges and counters that are called only on some paths through a body."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from fieldtwin.plc.st.syntax import tree as t

_FOLLOW = frozenset({"TON", "TOF", "TP", "R_TRIG", "F_TRIG", "CTU", "CTD", "CTUD"})
"""The standard blocks whose result depends on how often they are called. Counters also have variants such as CTU_DINT."""


def _follows(kind: str) -> bool:
    return kind in _FOLLOW or (kind.startswith("CT") and kind.partition("_")[0] in _FOLLOW)


def called_sometimes(body: Sequence[t.Statement], type_of: Callable[[t.Ref], str]) -> Iterator[tuple[str, t.Pos]]:
    """Yield each instance that an IF or CASE calls without calling it in every branch, with the place of its first such call.

    `type_of` returns the type of a variable in capitals. Calls in loops and in calls of actions are not examined.
    """
    always = _always(body, type_of)
    seen: set[str] = set()
    for call in _calls(body, type_of):
        name = call.ref.name
        if name.lower() not in always and name.lower() not in seen:
            seen.add(name.lower())
            yield name, call.pos


def _calls(body: Sequence[t.Statement], type_of: Callable[[t.Ref], str]) -> Iterator[t.Call]:
    for statement in body:
        if isinstance(statement, t.CallStatement) and _follows(type_of(statement.call.ref)):
            yield statement.call
        for inner in _branches(statement) or ():
            yield from _calls(inner, type_of)


def _always(body: Sequence[t.Statement], type_of: Callable[[t.Ref], str]) -> set[str]:
    """Return the instances that every path through a body calls."""
    found = set()
    for statement in body:
        if isinstance(statement, t.CallStatement) and _follows(type_of(statement.call.ref)):
            found.add(statement.call.ref.name.lower())
        elif branches := _branches(statement):
            found |= set.intersection(*(_always(branch, type_of) for branch in branches))
    return found


def _branches(statement: t.Statement) -> list[tuple[t.Statement, ...]]:
    """Return the bodies of which an IF or CASE executes one; none for other statements."""
    if isinstance(statement, t.If | t.Case):
        return [*(body for _, body in statement.branches), statement.otherwise]
    return []
