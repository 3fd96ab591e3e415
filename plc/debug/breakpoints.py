"""Breakpoints with conditions and hit counts, and logpoints, which write a message and do not stop."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.debug.expressions import Expression
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.inspection import literal

MAX_MESSAGE = 1000
"""The longest message of a logpoint, in characters."""
_HITS = re.compile(r"\s*(==|=|>=|>|%)?\s*(\d{1,9})\s*")
_PARTS = re.compile(r"\{([^{}]*)\}")

Compile = Callable[[str, str, ty.Type | None], Expression]
"""Compiles an expression in the scope of the POU with this key. Raises `UsageError`."""


@dataclass(frozen=True, slots=True)
class HitCondition:
    """At which hits a breakpoint stops: ``5`` or ``= 5``, ``>= 5``, ``> 5``, or ``% 5`` for each fifth hit."""

    operator: str
    count: int

    def holds(self, hits: int) -> bool:
        if self.operator == "%":
            return hits % self.count == 0
        return (
            hits >= self.count
            if self.operator == ">="
            else hits > self.count
            if self.operator == ">"
            else hits == self.count
        )


def hit_condition(text: str) -> HitCondition | None:
    """Return the hit condition of a breakpoint; None for an empty text. Raises `UsageError`."""
    if not text.strip():
        return None
    found = _HITS.fullmatch(text)
    operator, count = (found[1] or "=", int(found[2])) if found else ("", 0)
    if count == 0 and operator != ">=" and operator != ">":
        raise UsageError("the hit count of a breakpoint", expected="5, >= 5, > 5 or % 5", got=text.strip())
    return HitCondition(operator.replace("==", "="), count)


@dataclass(slots=True)
class Breakpoint:
    """A breakpoint at a line. `hits` counts how often the line was reached while the `condition` was TRUE."""

    compile: Compile
    condition: str = ""
    hit_condition: HitCondition | None = None
    message: str = ""
    """The message of a logpoint, with expressions in braces; empty for a breakpoint that stops."""
    hits: int = 0
    _compiled: dict[tuple[str, str], Expression] = field(default_factory=dict)
    """By the key of a POU and the text of an expression: POUs that share a line have their own variables."""

    def check(self, pou: str) -> None:
        """Raise `UsageError` if the condition or the message is not valid in a POU."""
        if self.condition:
            self._expression(pou, self.condition, ty.BOOL)
        for text in _PARTS.findall(self.message):
            self._expression(pou, text, None)

    def reached(self, pou: str, frame: FrameType) -> bool:
        """Count a hit, and return whether it fulfils the conditions. Raises `UsageError` if the condition has no value."""
        if self.condition and not self._value(pou, self.condition, ty.BOOL, frame)[1]:
            return False
        self.hits += 1
        return self.hit_condition is None or self.hit_condition.holds(self.hits)

    def text(self, pou: str, frame: FrameType) -> str:
        """Return the message of a logpoint with the values of its expressions, or with the reason why one has no value."""

        def shown(found: re.Match[str]) -> str:
            try:
                return literal(*self._value(pou, found[1], None, frame))
            except UsageError as e:
                return f"<{e.message}>"

        return _PARTS.sub(shown, self.message)[:MAX_MESSAGE]

    def _value(self, pou: str, text: str, wanted: ty.Type | None, frame: FrameType) -> tuple[ty.Type, Any]:
        expression = self._expression(pou, text, wanted)
        return expression.type, expression.value(frame.f_globals, frame.f_locals)

    def _expression(self, pou: str, text: str, wanted: ty.Type | None) -> Expression:
        key = pou, text
        if key not in self._compiled:
            self._compiled[key] = self.compile(pou, text, wanted)
        return self._compiled[key]
