"""Orders variables so that each gets its initial value after the variables that its initial value uses."""

from __future__ import annotations

from collections.abc import Sequence

from fieldtwin.plc.st.compiler.scope import Environment, Symbol
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.walk import nodes

Variable = tuple[t.VarDecl, Symbol]


def in_order(env: Environment, variables: Sequence[Variable]) -> list[Variable]:
    """Return the variables in their order, but each after those that it uses.

    Adds an error to those of `env` for variables that use each other; they stay in their order.
    """
    by_name: dict[str, list[Variable]] = {}
    for one in variables:
        by_name.setdefault(one[0].name.lower(), []).append(one)
    done: dict[int, Variable] = {}
    for one in variables:
        _add(env, one, by_name, done)
    return list(done.values())


def _add(env: Environment, first: Variable, by_name: dict[str, list[Variable]], done: dict[int, Variable]) -> None:
    waiting, path = [(first, iter(_used(first, by_name)))], {id(first[0])}
    while waiting:
        one, used = waiting[-1]
        for other in used:
            if id(other[0]) in path:
                pos = one[0].pos
                env.collected(
                    env.error(pos, f"the initial values of {one[0].name} and {other[0].name} need each other")
                )
            elif id(other[0]) not in done:
                path.add(id(other[0]))
                waiting.append((other, iter(_used(other, by_name))))
                break
        else:
            waiting.pop()
            path.discard(id(one[0]))
            done.setdefault(id(one[0]), one)


def _used(one: Variable, by_name: dict[str, list[Variable]]) -> list[Variable]:
    """Return the variables that the initial value of a variable uses. A member ``list.variable`` counts as the variable."""
    refs = [node for node in nodes((one[0].initial, one[0].type)) if isinstance(node, t.Ref)]
    names = [ref.name.lower() for ref in refs]
    names += [
        s.name.lower()
        for ref in refs
        if ref.name.lower() not in by_name
        for s in ref.selectors
        if isinstance(s, t.Member)
    ]
    return [other for name in names for other in by_name.get(name, []) if other[0] is not one[0]]
