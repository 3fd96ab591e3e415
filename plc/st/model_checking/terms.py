"""Functions on expressions of Z3."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import z3


def subterms(*expressions: Any, seen: set[int] | None = None) -> Iterator[Any]:
    """Return every part of the expressions once, without those whose numbers are in `seen`, which is extended."""
    seen = set() if seen is None else seen
    waiting = list(expressions)
    while waiting:
        each = waiting.pop()
        if each.get_id() not in seen:
            seen.add(each.get_id())
            yield each
            waiting += each.children()


def variables_of(*expressions: Any) -> dict[int, Any]:
    """Return the variables in the expressions, by their number in Z3."""
    return {
        each.get_id(): each
        for each in subterms(*expressions)
        if z3.is_const(each) and each.decl().kind() == z3.Z3_OP_UNINTERPRETED
    }


class Relaxed:
    """A question without floating-point numbers: each condition and bit vector that is computed from them may have any value.

    If it has no answer, neither has the original question; and this is found much faster.
    """

    def __init__(self, timeout_ms: int) -> None:
        self._solver = z3.Solver()
        self._solver.set("timeout", timeout_ms)
        self._seen: set[int] = set()
        self._pairs: list[tuple[Any, Any]] = []
        self._kept: list[Any] = []
        """The expressions whose numbers are in `_seen`: Z3 may give the number of a deleted expression to a new one."""

    def add(self, condition: Any) -> None:
        self._solver.add(self._relaxed(condition))

    def has_no_answer(self, condition: Any) -> bool:
        """Return whether `condition` contradicts those that were added. False if this is not found in time."""
        return bool(self._solver.check(self._relaxed(condition)) == z3.unsat)

    def _relaxed(self, condition: Any) -> Any:
        self._kept.append(condition)
        for each in subterms(condition, seen=self._seen):
            if (z3.is_bool(each) or z3.is_bv(each)) and any(z3.is_fp(child) for child in each.children()):
                self._pairs.append((each, z3.FreshConst(each.sort())))
        return z3.substitute(condition, *self._pairs) if self._pairs else condition
