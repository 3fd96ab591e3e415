"""Formulas of a simulation: ``speed + (demand - speed) * dt / 0.8``, ``sine(11.5, 0.4, 600) + noise(0.01)``.

`fieldtwin.gateway.core.expressions` defines the grammar. A formula is converted to a function of named values. All values are
floats; a comparison gives 1.0 or 0.0. Times are in seconds. A result that cannot be computed (a division by zero, the root of a
negative number) is NaN, which means "no value".
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Collection, Mapping
from itertools import pairwise
from random import Random

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.expressions import ARITHMETIC, COMPARE, OF_NUMBERS, Parsed, clamp, dotted
from fieldtwin.gateway.core.files.nearest import did_you_mean

Values = Mapping[str, float]
Compute = Callable[[Values], float]
"""A function that returns the value of a formula for the values of its names."""

TIME, STEP = "t", "dt"
"""Names in formulas: the seconds since the simulation began, and the seconds since the previous step."""


def _ramp(t: float, start: float, end: float, over_s: float) -> float:
    return start + (end - start) * clamp(t / over_s, 0.0, 1.0)


def _sine(t: float, mean: float, amplitude: float, period_s: float) -> float:
    return mean + amplitude * math.sin(2 * math.pi * t / period_s)


def _square(t: float, low: float, high: float, period_s: float) -> float:
    return low if t % period_s < period_s / 2 else high


def _triangle(t: float, low: float, high: float, period_s: float) -> float:
    return low + (high - low) * (1.0 - abs(2.0 * (t % period_s) / period_s - 1.0))


def _sawtooth(t: float, low: float, high: float, period_s: float) -> float:
    return low + (high - low) * (t % period_s) / period_s


def _pulse(t: float, start_s: float, width_s: float) -> float:
    return float(start_s <= t < start_s + width_s)


OF_TIME: dict[str, tuple[int, Callable[..., float]]] = {
    "pulse": (2, _pulse),
    "ramp": (3, _ramp),
    "sawtooth": (3, _sawtooth),
    "sine": (3, _sine),
    "square": (3, _square),
    "triangle": (3, _triangle),
}
"""Functions of time: ``ramp(START, END, OVER_S)``, ``sine(MEAN, AMPLITUDE, PERIOD_S)``, ``square(LOW, HIGH, PERIOD_S)``...
"""

CONSTANTS = {"pi": math.pi, "nan": math.nan, "true": 1.0, "false": 0.0}
FUNCTIONS = (*sorted([*OF_NUMBERS, *OF_TIME]), "noise")


def uses_time(text: str) -> bool:
    """Return whether the valid formula `text` contains `t` or a function of time. Its values then follow the time of the run."""
    names = (node.id for node in ast.walk(Parsed(text, "formula", "").tree) if isinstance(node, ast.Name))
    return any(name == TIME or name in OF_TIME for name in names)


class Formula:
    """A formula, parsed once from `text`. `names` are the names that it uses. Raises `UsageError` for an invalid formula.

    `known` are the names that may be used; `noise(SIGMA)` draws from `random`, once for each evaluation.
    """

    def __init__(self, text: str, known: Collection[str], random: Random) -> None:
        self.text = text
        self.names: list[str] = []
        self._known = known
        self._random = random
        self._parsed = Parsed(text, "formula", "for example: speed + (demand - speed) * dt / 0.8")
        self._compute = self._made(self._parsed.tree)

    def __call__(self, values: Values) -> float:
        """Return the present value; NaN if it cannot be computed."""
        try:
            return float(self._compute(values))
        except (ArithmeticError, ValueError):
            return math.nan

    def _made(self, node: ast.expr) -> Compute:
        match node:
            case ast.Constant(value=bool() | int() | float() as number):
                return _constant(number)
            case ast.Name() | ast.Attribute():
                return self._named(node)
            case ast.BinOp(left=left, op=op, right=right):
                return _both(ARITHMETIC[type(op)], self._made(left), self._made(right))
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                negated = self._made(operand)
                return lambda values: -negated(values)
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                denied = self._made(operand)
                return lambda values: float(not denied(values))
            case ast.BoolOp(op=op, values=values):
                return _all_or_any(isinstance(op, ast.And), [self._made(part) for part in values])
            case ast.Compare(left=left, ops=ops, comparators=others):
                parts = [self._made(part) for part in (left, *others)]
                each = [_both(COMPARE[type(op)], *pair) for op, pair in zip(ops, pairwise(parts), strict=True)]
                return each[0] if len(each) == 1 else _all_or_any(True, each)
            case ast.IfExp(test=test, body=body, orelse=other):
                return _either(*(self._made(part) for part in (test, body, other)))
            case ast.Call(func=name, args=args):
                return self._called(name, [self._made(arg) for arg in args])
        raise self._parsed.error("a text in a formula", node, got=ast.unparse(node), expected="numbers")

    def _named(self, node: ast.expr) -> Compute:
        name = dotted(node)
        if name in CONSTANTS:
            return _constant(CONSTANTS[name])
        if name not in self._known and name not in (TIME, STEP):
            raise self._parsed.error(
                f"there is no value or function {name!r}",
                node,
                expected=", ".join([TIME, STEP, *self._known]),
                hint=did_you_mean(name, [TIME, STEP, *self._known, *CONSTANTS]),
            )
        self.names.append(name)
        return operator.itemgetter(name)

    def _called(self, node: ast.expr, args: list[Compute]) -> Compute:
        name = dotted(node)
        if name == "noise":
            _count(name, 1, args)
            random, (sigma,) = self._random, args
            return lambda values: random.gauss(0.0, sigma(values))
        if name in OF_TIME:
            count, of_time = OF_TIME[name]
            _count(name, count, args)
            return lambda values: of_time(values[TIME], *(arg(values) for arg in args))
        if name in OF_NUMBERS:
            count, plain = OF_NUMBERS[name]
            _count(name, count, args)
            return lambda values: plain(*(arg(values) for arg in args))
        hint = did_you_mean(name, FUNCTIONS)
        raise self._parsed.error(f"no function {name!r}", node, expected=", ".join(FUNCTIONS), hint=hint)


def _constant(number: float) -> Compute:
    try:
        value = float(number)
    except OverflowError:
        raise UsageError("a number too large", expected="a double") from None
    return lambda values: value


def _both(function: Callable[[float, float], float], left: Compute, right: Compute) -> Compute:
    return lambda values: float(function(left(values), right(values)))


def _either(test: Compute, body: Compute, other: Compute) -> Compute:
    return lambda values: body(values) if test(values) else other(values)


def _all_or_any(every: bool, parts: list[Compute]) -> Compute:
    judge = all if every else any
    return lambda values: float(judge(part(values) for part in parts))


def _count(name: str, count: int, args: list[Compute]) -> None:
    if len(args) != count:
        raise UsageError(f"{name}() in a formula", expected=f"{count} argument(s)", got=str(len(args)))
