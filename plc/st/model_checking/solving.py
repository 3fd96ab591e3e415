"""Answers questions about a transition with Z3: bounded model checking, and k-induction for all scans.

Bounded model checking looks for a violation in the first n scans. For all scans, k-induction assumes that k scans in a row from
any state keep the properties, and asks whether the next scan can violate one (M. Sheeran, S. Singh, G. Stalmarck: "Checking
safety properties using induction and a SAT-solver", 2000). Properties that hold together are assumed together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import z3

from fieldtwin.plc.st.model_checking.transition import InputSymbol, Transition

FAILS = -1
"""The number of the property that no scan ends with an error."""
_MIN_MS = 1
_TACTICS = (
    "simplify", "fpa2bv", "simplify", "propagate-values", "solve-eqs", "elim-uncnstr", "simplify", "bit-blast", "sat",
)  # fmt: skip
"""The steps to a SAT problem. For such chains of scans this is several times faster than the general solver."""


@dataclass(frozen=True, slots=True)
class Limits:
    """`scans` is the largest number of scans of a counterexample. `left_s` returns the seconds that are left."""

    scans: int
    left_s: Callable[[], float]


@dataclass(frozen=True, slots=True)
class Scan:
    """The inputs of one scan: the time since the scan before in ns, the values, and the qualities that the program asks for."""

    after_ns: int
    values: tuple[tuple[str, Any], ...]
    good: tuple[tuple[str, bool], ...] = ()


@dataclass
class Answer:
    """The knowledge about a property: it is `proved` by k-induction (`proved` is k), or the scans `way` violate it, or it is not
    violated in the first `scans` scans. `reason` says why it is not known for all scans."""

    proved: int | None = None
    way: tuple[Scan, ...] | None = None
    scans: int = 0
    reason: str = ""


@dataclass
class _Chain:
    """Consecutive scans: the variables of the state before each of them, and those of its inputs."""

    transition: Transition
    name: str
    solver: Any = field(default_factory=lambda: z3.Then(*_TACTICS).solver())
    states: list[Sequence[Any]] = field(default_factory=list)
    inputs: list[Sequence[Any]] = field(default_factory=list)

    def add_scan(self) -> None:
        """Add one scan, whose inputs and state are limited."""
        n = len(self.inputs)
        self.inputs.append([z3.FreshConst(v.sort(), f"{self.name}{n}") for v in self.transition.inputs])
        self.solver.add(self.at(self.transition.limited, n), self.at(self.transition.assumed, n))

    def go_on(self) -> None:
        """Add the state after the last scan, which ended without an error."""
        n = len(self.inputs) - 1
        self.solver.add(z3.Not(self.at(self.transition.fails, n)))
        following = [z3.FreshConst(v.sort(), f"{self.name}{n}") for v in self.transition.state]
        self.states.append(following)
        for variable, value in zip(following, self.transition.following, strict=True):
            self.solver.add(variable == self.at(value, n))

    def at(self, expression: Any, n: int) -> Any:
        """Return an expression of the transition for the scan n, which counts from 0."""
        old = (*self.transition.state, *self.transition.inputs)
        return z3.substitute(expression, *zip(old, (*self.states[n], *self.inputs[n]), strict=True))

    def holds(self, number: int, n: int) -> Any:
        """Return the condition under which a property holds after the scan n."""
        fails = self.at(self.transition.fails, n)
        if number == FAILS:
            return z3.Not(fails)
        return z3.Or(fails, self.at(self.transition.properties[number], n))

    def ask(self, condition: Any, left_s: Callable[[], float]) -> Any:
        """Return a model in which `condition` is true, None if it contradicts the scans, and False if the time is over."""
        left_ms = int(left_s() * 1000)
        if left_ms < _MIN_MS:
            return False
        self.solver.set("timeout", left_ms)
        self.solver.push()
        self.solver.add(condition)
        found = self.solver.check()
        model = self.solver.model() if found == z3.sat else None if found == z3.unsat else False
        self.solver.pop()
        return model

    def scan(self, model: Any, n: int) -> Scan:
        """Return the inputs of the scan n in a model."""
        pairs = list(zip(self.transition.inputs, self.inputs[n], strict=True))

        def value_of(expression: Any) -> Any:
            return model.eval(z3.substitute(expression, *pairs), model_completion=True)

        known = [(each.name, _value(each, value_of)) for each in self.transition.symbols]
        good = [(name, z3.is_true(value_of(variable))) for name, variable in self.transition.qualities.items()]
        return Scan(known[0][1], tuple(known[1:]), tuple(good))


def _value(symbol: InputSymbol, value_of: Callable[[Any], Any]) -> Any:
    value = symbol.value
    if isinstance(value, z3.BoolRef):
        return z3.is_true(value_of(value))
    if isinstance(value, bool | int | float):
        return value
    found = value_of(value.expr)
    if z3.is_bv(found):
        return found.as_signed_long()
    return float_of(found)


def float_of(number: Any) -> float:
    """Return a floating-point constant of Z3 as a number of Python."""
    if number.isNaN():
        return float("nan")
    if number.isInf():
        return float("-inf") if number.isNegative() else float("inf")
    exact = z3.simplify(z3.fpToReal(number))
    magnitude = exact.numerator_as_long() / exact.denominator_as_long()
    return -0.0 if number.isNegative() and magnitude == 0 else float(magnitude)


def solve(
    transition: Transition, numbers: Sequence[int], limits: Limits, accepts: Callable[[int, tuple[Scan, ...]], str]
) -> dict[int, Answer]:
    """Return an answer about each property in `numbers`, which are indices of `Transition.properties`, or `FAILS`.

    `accepts` is called with each counterexample. It returns "" if the program does the same, or the reason why the property
    remains open.
    """
    return _Search(transition, list(numbers), limits, accepts).answers()


class _Search:
    def __init__(
        self, transition: Transition, open_: list[int], limits: Limits, accepts: Callable[[int, tuple[Scan, ...]], str]
    ) -> None:
        self._transition, self._open, self._limits, self._accepts = transition, open_, limits, accepts
        self._found = {number: Answer() for number in open_}
        self._proved: list[int] = []

    def answers(self) -> dict[int, Answer]:
        base, step = _Chain(self._transition, "b"), _Chain(self._transition, "i")
        base.states.append(self._transition.initial)
        step.states.append([z3.FreshConst(v.sort(), "any") for v in self._transition.state])
        step.add_scan()
        if self._transition.first is not None:  # the first scans are those of the other chain
            step.solver.add(z3.Not(step.at(self._transition.first, 0)))
        for k in range(self._limits.scans):
            base.add_scan()
            if not self._search(base, k):
                self._give_up("the time limit was reached")
                break
            base.go_on()
            if self._open and not self._induct(step, k):
                self._give_up("the time limit was reached")
                break
            if not self._open:
                break
            step.go_on()
            step.add_scan()
        self._give_up(f"the limit of {self._limits.scans} scans was reached")
        return self._found

    def _give_up(self, reason: str) -> None:
        for number in self._open:
            self._found[number].reason = reason
        self._open = []

    def _search(self, chain: _Chain, n: int) -> bool:
        """Look for violations in the scan n. Return False if the time is over."""
        while self._open:
            violated = z3.Or(*(z3.Not(chain.holds(number, n)) for number in self._open))
            model = chain.ask(violated, self._limits.left_s)
            if model is False:
                return False
            if model is None:
                break
            way = tuple(chain.scan(model, each) for each in range(n + 1))
            broken = [number for number in self._open if z3.is_false(model.eval(chain.holds(number, n), True))]
            for number in broken:
                self._open.remove(number)
                reason = self._accepts(number, way)
                if reason:
                    self._found[number].reason = reason
                else:
                    self._found[number].way = way
        for number in self._open:
            self._found[number].scans = n + 1
        return True

    def _induct(self, chain: _Chain, k: int) -> bool:
        """Find the properties that hold after any scan if they hold after the k scans before it. Return False without time."""
        lemmas = [chain.holds(number, n) for number in self._proved for n in range(k + 1)]
        kept = list(self._open)
        while kept:
            assumed = [chain.holds(number, n) for number in kept for n in range(k)]
            violated = z3.Or(*(z3.Not(chain.holds(number, k)) for number in kept))
            model = chain.ask(z3.And(*lemmas, *assumed, violated), self._limits.left_s)
            if model is False:
                return False
            if model is None:
                break
            kept = [number for number in kept if not z3.is_false(model.eval(chain.holds(number, k), True))]
        for number in kept:
            self._open.remove(number)
            self._proved.append(number)
            self._found[number].proved = k
        return True
