"""Symbolic values: integers with limits, floating-point numbers, conditions, and choices between values.

A symbolic integer behaves as an integer of Python, without a fixed width: its limits are known, and its bit vector is wide enough
for them. Compiled programs reduce integers to the width of their type with operators of Python, so the same operators on
symbolic integers wrap around as the program does. A value that is known is a plain value of Python; a condition that is not known
is a ``z3.BoolRef``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import z3

from fieldtwin.plc.st.model_checking.execution.refusal import NotModelled

Condition = Any
"""``True``, ``False`` or a ``z3.BoolRef``."""
MAX_BITS = 160
"""A wider intermediate result is refused. The widest product of two values of 64 bits has 128."""


class Undefined:
    """The value of a variable on a path that does not assign it, and the result of an operation that has none."""


UNDEFINED = Undefined()


class Text:
    """A text that is not known. Its length, its number and the result of a comparison may have any value."""


TEXT = Text()


@dataclass(frozen=True, slots=True, eq=False)
class Int:
    """An integer that is not known: a signed bit vector of exactly `width(low, high)` bits, from `low` to `high`."""

    expr: Any
    low: int
    high: int


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """One of several values that cannot be merged, such as None and an integer. Exactly one condition is true."""

    options: tuple[tuple[Condition, Any], ...]


# -- conditions -----------------------------------------------------------------------------------------------------------


def both(*conditions: Condition) -> Condition:
    """Return whether all conditions are true."""
    rest = []
    for condition in conditions:
        if condition is False:
            return False
        if condition is not True:
            rest.append(condition)
    return True if not rest else rest[0] if len(rest) == 1 else z3.And(*rest)


def either(*conditions: Condition) -> Condition:
    """Return whether at least one condition is true."""
    rest = []
    for condition in conditions:
        if condition is True:
            return True
        if condition is not False:
            rest.append(condition)
    return False if not rest else rest[0] if len(rest) == 1 else z3.Or(*rest)


def negated(condition: Condition) -> Condition:
    if isinstance(condition, bool):
        return not condition
    return condition.arg(0) if z3.is_not(condition) else z3.Not(condition)


def as_condition(value: Condition) -> Any:
    """Return a condition as an expression of Z3."""
    return z3.BoolVal(value) if isinstance(value, bool) else value


def is_condition(value: Any) -> bool:
    return isinstance(value, bool | z3.BoolRef)


# -- integers -------------------------------------------------------------------------------------------------------------


def width(low: int, high: int) -> int:
    """Return the number of bits of a signed integer from `low` to `high`."""
    return max((low if low >= 0 else ~low).bit_length(), (high if high >= 0 else ~high).bit_length()) + 1


def is_integer(value: Any) -> bool:
    return isinstance(value, Int) or (isinstance(value, int) and not isinstance(value, bool))


def limits(value: Int | int) -> tuple[int, int]:
    return (value.low, value.high) if isinstance(value, Int) else (value, value)


def bits_of(value: Int | int, bits: int) -> Any:
    """Return the lowest `bits` bits of `value` as a bit vector; a narrower value is extended by its sign."""
    if not isinstance(value, Int):
        return z3.BitVecVal(value, bits)
    size = value.expr.size()
    if size < bits:
        return z3.SignExt(bits - size, value.expr)
    return value.expr if size == bits else z3.Extract(bits - 1, 0, value.expr)


def made(expr: Any, low: int, high: int) -> Int | int:
    """Return the value of the signed bit vector `expr`, which lies between `low` and `high`."""
    if low == high:
        return low
    bits = width(low, high)
    if bits > MAX_BITS:
        raise NotModelled("an integer of more than 160 bits")
    size = expr.size()
    if size < bits:
        expr = z3.SignExt(bits - size, expr)
    elif size > bits:
        expr = z3.Extract(bits - 1, 0, expr)
    return Int(expr, low, high)


def _limited(a: Int | int, b: Int | int, function: Callable[[int, int], int]) -> tuple[int, int]:
    corners = [function(x, y) for x in limits(a) for y in limits(b)]
    return min(corners), max(corners)


def add(a: Int | int, b: Int | int) -> Int | int:
    low, high = _limited(a, b, lambda x, y: x + y)
    bits = width(low, high)
    return made(bits_of(a, bits) + bits_of(b, bits), low, high)


def subtract(a: Int | int, b: Int | int) -> Int | int:
    low, high = _limited(a, b, lambda x, y: x - y)
    bits = width(low, high)
    return made(bits_of(a, bits) - bits_of(b, bits), low, high)


def multiply(a: Int | int, b: Int | int) -> Int | int:
    low, high = _limited(a, b, lambda x, y: x * y)
    bits = width(low, high)
    if bits > MAX_BITS:
        raise NotModelled("an integer of more than 160 bits")
    return made(bits_of(a, bits) * bits_of(b, bits), low, high)


def bit_and(a: Int | int, b: Int | int) -> Int | int:
    (a_low, a_high), (b_low, b_high) = limits(a), limits(b)
    for value, low, high, mask in ((a, a_low, a_high, b), (b, b_low, b_high, a)):
        if not isinstance(mask, Int) and mask >= 0 and mask & (mask + 1) == 0:
            if low >= 0 and high <= mask:
                return value
            bits = mask.bit_length()
            return made(z3.ZeroExt(1, bits_of(value, bits)), 0, mask) if bits else 0
    bits = width(min(a_low, b_low), max(a_high, b_high))
    whole = 1 << (bits - 1)
    low = 0 if a_low >= 0 or b_low >= 0 else -whole
    high = min([limit for limit, least in ((a_high, a_low), (b_high, b_low)) if least >= 0] or [whole - 1])
    return made(bits_of(a, bits) & bits_of(b, bits), low, high)


def bit_or(a: Int | int, b: Int | int) -> Int | int:
    return _bitwise(a, b, lambda x, y: x | y)


def bit_xor(a: Int | int, b: Int | int) -> Int | int:
    return _bitwise(a, b, lambda x, y: x ^ y)


def _bitwise(a: Int | int, b: Int | int, function: Callable[[Any, Any], Any]) -> Int | int:
    (a_low, a_high), (b_low, b_high) = limits(a), limits(b)
    bits = width(min(a_low, b_low), max(a_high, b_high))
    whole = 1 << (bits - 1)
    return made(function(bits_of(a, bits), bits_of(b, bits)), 0 if a_low >= 0 and b_low >= 0 else -whole, whole - 1)


def shift_left(a: Int | int, count: Int | int) -> Int | int:
    return _shifted(a, count, lambda n: multiply(a, 1 << n))


def shift_right(a: Int | int, count: Int | int) -> Int | int:
    def by(n: int) -> Int | int:
        low, high = (limit >> n for limit in limits(a))
        bits = width(*limits(a))
        return made(bits_of(a, bits) >> n, low, high)

    return _shifted(a, count, by)


def _shifted(a: Int | int, count: Int | int, by: Callable[[int], Int | int]) -> Int | int:
    """Return the result of `by` for `count`. Compiled programs limit each count to 0..64, so other counts cannot occur."""
    if not isinstance(count, Int):
        return by(count)
    low, high = max(0, count.low), min(64, count.high)
    result = by(max(low, high))
    for n in range(high - 1, low - 1, -1):
        result = merged_integers(compare("==", count, n), by(n), result)
    return result


def floor_divide(a: Int | int, b: Int | int) -> Int | int:
    """Return ``a // b`` of Python. A divisor of 0 is excluded before by the program's own check."""
    (a_low, a_high), (b_low, b_high) = limits(a), limits(b)
    divisors = [d for d in (b_low, b_high, -1, 1) if d != 0 and b_low <= d <= b_high]
    if not divisors:
        return 0
    found = [n // d for n in (a_low, a_high) for d in divisors] + [0] * (a_low <= 0 <= a_high)
    bits = width(min(a_low, b_low), max(a_high, b_high)) + 1
    x, y = bits_of(a, bits), bits_of(b, bits)
    if a_low >= 0 and b_low >= 0:
        return made(z3.UDiv(x, y), min(found), max(found))
    return made(
        (x - x % y) / y, min(found), max(found)
    )  # of bit vectors, % has the sign of the divisor and / truncates


def floor_modulo(a: Int | int, b: Int | int) -> Int | int:
    """Return ``a % b`` of Python, which has the sign of the divisor."""
    (a_low, a_high), (b_low, b_high) = limits(a), limits(b)
    bits = width(min(a_low, b_low), max(a_high, b_high)) + 1
    x, y = bits_of(a, bits), bits_of(b, bits)
    if a_low >= 0 and b_low >= 0:
        return made(z3.URem(x, y), 0, max(0, min(a_high, b_high - 1)))
    return made(x % y, min(0, b_low + 1), max(0, b_high - 1))


def negative(a: Int | int) -> Int | int:
    return subtract(0, a)


def compare(op: str, a: Int | int, b: Int | int) -> Condition:
    """Return the condition ``a op b``, with an operator of Python."""
    if op in (">", ">="):
        return compare("<" if op == ">" else "<=", b, a)
    if op == "!=":
        return negated(compare("==", a, b))
    (a_low, a_high), (b_low, b_high) = limits(a), limits(b)
    if op == "==":
        if a_high < b_low or b_high < a_low:
            return False
        if a_low == a_high == b_low == b_high:
            return True
    else:
        strict = op == "<"
        if a_high < b_low or (not strict and a_high == b_low):
            return True
        if a_low > b_high or (strict and a_low == b_high):
            return False
    bits = width(min(a_low, b_low), max(a_high, b_high))
    x, y = bits_of(a, bits), bits_of(b, bits)
    return x == y if op == "==" else x < y if op == "<" else x <= y


def merged_integers(condition: Condition, yes: Int | int, no: Int | int) -> Int | int:
    if not isinstance(yes, Int) and yes == no:
        return yes
    (a, b), (c, d) = limits(yes), limits(no)
    low, high = min(a, c), max(b, d)
    bits = width(low, high)
    return made(z3.If(condition, bits_of(yes, bits), bits_of(no, bits)), low, high)
