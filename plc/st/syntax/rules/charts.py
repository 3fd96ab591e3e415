"""The rules of the grammar for sequential function charts (IEC 61131-3, 6.7): steps and transitions as nodes of the tree.

This module does not check a chart; `fieldtwin.plc.st.charts.translate` does.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from lark import Token, v_args
from lark.tree import Meta

from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.rules.base import Bad, Rules


@v_args(meta=True)
class ChartRules(Rules):
    """The methods of the transformer for steps and transitions."""

    def step(self, meta: Meta, items: list[Any]) -> t.Step:
        word, name, *associations = items
        return t.Step(self._pos(name), str(name), word.type == "INITIAL_STEP", tuple(associations))

    def association(self, meta: Meta, items: list[Any]) -> t.Association:
        """Return an action of a step. Without a qualifier it is N (6.7.4.3)."""
        name, *rest = items
        qualifier = str(rest[0]).upper() if rest else "N"
        return t.Association(self._pos(name), str(name), qualifier, tuple(rest[1:]))

    def transition(self, meta: Meta, items: list[Any]) -> t.Transition:
        word, *rest = items
        name = str(rest.pop(0)) if isinstance(rest[0], Token) else ""
        priority = rest.pop(0) if isinstance(rest[0], int) else None
        sources, targets, condition = rest
        if not isinstance(condition, tuple):
            return t.Transition(self._pos(word), name, priority, sources, targets, condition)
        if not name:
            raise Bad(word, "a transition with a body needs a name, to which the body assigns the condition")
        read = t.Ref(self._pos(word), name)
        return t.Transition(self._pos(word), name, priority, sources, targets, read, body=condition)

    def priority(self, meta: Meta, items: list[Any]) -> int:
        return int(items[0])

    def step_names(self, meta: Meta, items: list[Any]) -> tuple[str, ...]:
        return tuple(str(item) for item in items)


def chart_of(items: Iterable[Any]) -> t.Chart | None:
    """Return the chart in the body of a POU or action; None if the body has neither steps nor transitions."""
    parts = tuple(items)
    steps = tuple(i for i in parts if isinstance(i, t.Step))
    transitions = tuple(i for i in parts if isinstance(i, t.Transition))
    return t.Chart(steps, transitions) if steps or transitions else None
