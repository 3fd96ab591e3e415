"""Formulas of a simulation: ``speed + (demand - speed) * dt / 0.8``, ``sine(11.5, 0.4, 600) + noise(0.01)``.

They use a small part of Python's expressions. Python's parser reads them, and they are converted to functions of named values; no
code of the file is ever executed. All values are floats; a comparison gives 1.0 or 0.0. Times are in seconds. A result that
cannot be computed (a division by zero, the root of a negative number) is NaN, which means "no value".
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Collection, Mapping
from random import Random

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean

Values = Mapping[str, float]
Compute = Callable[[Values], float]
"""Returns the value of a formula for the values of its names."""

TIME, STEP = "t", "dt"
"""Seconds since the simulation began; seconds since the previous step."""
LONGEST, DEEPEST = 1000, 50

_ARITHMETIC: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Mod: math.fmod,
    ast.Pow: math.pow,
}
_COMPARE: dict[type[ast.cmpop], Callable[[float, float], bool]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}


def _clamp(x: float, low: float, high: float) -> float:
    return min(max(x, low), high)


def _deadband(x: float, width: float) -> float:
    return 0.0 if abs(x) <= width else x


PLAIN: dict[str, tuple[int, Callable[..., float]]] = {
    "abs": (1, abs),
    "atan2": (2, math.atan2),
    "clamp": (3, _clamp),
    "cos": (1, math.cos),
    "deadband": (2, _deadband),
    "exp": (1, math.exp),
    "floor": (1, math.floor),
    "hypot": (2, math.hypot),
    "log": (1, math.log),
    "max": (2, max),
    "min": (2, min),
    "round": (1, round),
    "sin": (1, math.sin),
    "sqrt": (1, math.sqrt),
    "tan": (1, math.tan),
}
"""Functions of their arguments: number of arguments and function. Angles are in radians."""


def _ramp(t: float, start: float, end: float, over_s: float) -> float:
    return start + (end - start) * _clamp(t / over_s, 0.0, 1.0)


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
FUNCTIONS = (*sorted([*PLAIN, *OF_TIME]), "noise")


class Formula:
    """A formula, parsed once from `text`. `names` are the names that it uses. Raises `UsageError` for an invalid formula.

    `known` are the names that may be used; `noise(SIGMA)` draws from `random`, once for each evaluation.
    """

    def __init__(self, text: str, known: Collection[str], random: Random) -> None:
        self.text = text
        self.names: list[str] = []
        self._known = known
        self._random = random
        if len(text) > LONGEST:
            raise UsageError("the formula is too long", expected=f"at most {LONGEST} characters", got=f"{len(text)}")
        try:
            tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as e:
            raise UsageError("no formula", got=text, hint="for example: speed + (demand - speed) * dt / 0.8") from e
        self._compute = self._made(tree, 0)

    def __call__(self, values: Values) -> float:
        """Return the present value; NaN if it cannot be computed."""
        try:
            return float(self._compute(values))
        except (ArithmeticError, ValueError):
            return math.nan

    def _made(self, node: ast.expr, depth: int) -> Compute:
        if depth > DEEPEST:
            raise UsageError("a formula nested too deep", expected=f"at most {DEEPEST} levels")
        match node:
            case ast.Constant(value=bool() | int() | float() as number):
                return _constant(number)
            case ast.Name(id=name):
                return self._named(name)
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _ARITHMETIC:
                return _both(_ARITHMETIC[type(op)], self._made(left, depth + 1), self._made(right, depth + 1))
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                negated = self._made(operand, depth + 1)
                return lambda values: -negated(values)
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                denied = self._made(operand, depth + 1)
                return lambda values: float(not denied(values))
            case ast.BoolOp(op=op, values=parts):
                return _all_or_any(isinstance(op, ast.And), [self._made(part, depth + 1) for part in parts])
            case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _COMPARE:
                return _both(_COMPARE[type(op)], self._made(left, depth + 1), self._made(right, depth + 1))
            case ast.IfExp(test=test, body=body, orelse=other):
                return _either(*(self._made(part, depth + 1) for part in (test, body, other)))
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
                return self._called(name, [self._made(arg, depth + 1) for arg in args])
        raise UsageError(
            "not understood in a formula",
            got=ast.unparse(node),
            expected="numbers, names, + - * / % **, comparisons, `A if B else C`, functions",
        )

    def _named(self, name: str) -> Compute:
        if name in CONSTANTS:
            return _constant(CONSTANTS[name])
        if name not in self._known and name not in (TIME, STEP):
            raise UsageError(
                f"there is no value or function {name!r}",
                expected=", ".join([TIME, STEP, *self._known]),
                hint=did_you_mean(name, [TIME, STEP, *self._known, *CONSTANTS]),
            )
        self.names.append(name)
        return operator.itemgetter(name)

    def _called(self, name: str, args: list[Compute]) -> Compute:
        if name == "noise":
            _count(name, 1, args)
            random, (sigma,) = self._random, args
            return lambda values: random.gauss(0.0, sigma(values))
        if name in OF_TIME:
            count, of_time = OF_TIME[name]
            _count(name, count, args)
            return lambda values: of_time(values[TIME], *(arg(values) for arg in args))
        if name in PLAIN:
            count, plain = PLAIN[name]
            _count(name, count, args)
            return lambda values: plain(*(arg(values) for arg in args))
        raise UsageError(f"no function {name!r}", expected=", ".join(FUNCTIONS), hint=did_you_mean(name, FUNCTIONS))


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
