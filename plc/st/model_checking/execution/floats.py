"""Symbolic floating-point numbers with the exact arithmetic of IEC 60559: REAL has 32 bits, LREAL 64.

Compiled programs compute in 64 bits and round each result of REAL to 32. For +, -, *, / and the square root this gives the
same as one operation in 32 bits, because 64 bits are more than twice as precise (S. Figueroa, "When is double rounding
innocuous?", 1995). The solver computes in 32 bits, which is much faster.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import z3

from fieldtwin.plc.st.model_checking.execution.symbolic import Condition, Int, as_condition, is_integer, limits, width
from fieldtwin.plc.st.values import real

EXACT = 2**53
"""Integers up to this size have an exact 64-bit floating-point number."""
_FUNCTIONS = {"+": z3.fpAdd, "-": z3.fpSub, "*": z3.fpMul, "/": z3.fpDiv}
_COMPARISONS = {"==": z3.fpEQ, "<": z3.fpLT, "<=": z3.fpLEQ, ">": z3.fpGT, ">=": z3.fpGEQ}


@dataclass(frozen=True, slots=True, eq=False)
class Float:
    """A number that is not known. `single`: it is a number of 32 bits, else of 64 bits; `expr` has that sort.

    `exact`: the operator and operands, if it is the result in 64 bits of an operation on numbers of 32 bits.
    """

    expr: Any
    single: bool = False
    exact: tuple[str, Any, Any] | None = None


def is_float(value: Any) -> bool:
    return isinstance(value, Float | float)


def nearest() -> Any:
    return z3.RoundNearestTiesToEven()


def fits_single(value: Float | float) -> bool:
    """Return whether the number has 32 bits."""
    if isinstance(value, Float):
        return value.single
    return math.isnan(value) or real(value) == value


def single(value: Float | float) -> Any:
    """Return a number for which `fits_single` is true as an expression of 32 bits."""
    return value.expr if isinstance(value, Float) else z3.FPVal(value, z3.Float32())


def double(value: Float | float) -> Any:
    """Return the number as an expression of 64 bits."""
    if not isinstance(value, Float):
        return z3.FPVal(value, z3.Float64())
    return z3.fpToFP(nearest(), value.expr, z3.Float64()) if value.single else value.expr


def of_integer(value: Int | int) -> Float | float:
    """Return ``float(value)`` of Python."""
    if not isinstance(value, Int):
        return float(value)
    return Float(z3.fpSignedToFP(nearest(), value.expr, z3.Float64()))


def operation(op: str, a: Float | float, b: Float | float) -> Float:
    exact = (op, a, b) if fits_single(a) and fits_single(b) else None
    return Float(_FUNCTIONS[op](nearest(), double(a), double(b)), exact=exact)


def rounded(value: Float | float) -> Float | float:
    """Return the number rounded to 32 bits."""
    if not isinstance(value, Float):
        return real(value)
    if value.single:
        return value
    if value.exact is not None:
        op, a, b = value.exact
        return Float(_FUNCTIONS[op](nearest(), single(a), single(b)), single=True)
    return Float(z3.fpToFP(nearest(), value.expr, z3.Float32()), single=True)


def negative(value: Float) -> Float:
    return Float(z3.fpNeg(value.expr), value.single)


def absolute(value: Float) -> Float:
    return Float(z3.fpAbs(value.expr), value.single)


def compare_floats(op: str, a: Float | float, b: Float | float) -> Condition:
    if op == "!=":
        return z3.Not(compare_floats("==", a, b))
    both_single = fits_single(a) and fits_single(b)
    form = single if both_single else double
    return _COMPARISONS[op](form(a), form(b))


def merged_floats(condition: Condition, yes: Float | float, no: Float | float) -> Float | float:
    if isinstance(yes, float) and isinstance(no, float) and repr(yes) == repr(no):
        return yes
    both_single = fits_single(yes) and fits_single(no)
    form = single if both_single else double
    return Float(z3.If(as_condition(condition), form(yes), form(no)), both_single)


def is_finite(value: Float | float) -> Condition:
    if isinstance(value, float):
        return math.isfinite(value)
    return z3.Not(z3.Or(z3.fpIsNaN(value.expr), z3.fpIsInf(value.expr)))


def to_integer(value: Float, low: int, high: int, cut: bool) -> tuple[Condition, Int | int]:
    """Return whether the rounded (or `cut`) number lies between `low` and `high`, and the number, which is valid only then."""
    mode = z3.RoundTowardZero() if cut else nearest()
    whole = z3.fpRoundToIntegral(mode, double(value))
    least, most = z3.FPVal(float(low), z3.Float64()), z3.FPVal(float(high), z3.Float64())
    inside = z3.And(is_finite(value), z3.fpGEQ(whole, least), _at_most(whole, most, high))
    bits = width(low, high)
    return inside, Int(z3.fpToSBV(z3.RoundTowardZero(), whole, z3.BitVecSort(bits)), low, high)


def _at_most(whole: Any, most: Any, high: int) -> Any:
    """Return whether `whole` is at most `high`, of which `most` is the nearest floating-point number."""
    return z3.fpLEQ(whole, most) if int(float(high)) <= high else z3.fpLT(whole, most)


def exact_division(a: Any, b: Any) -> bool:
    """Return whether ``a / b`` of two integers equals the quotient of their floating-point numbers."""
    return is_integer(a) and is_integer(b) and all(abs(n) <= EXACT for n in (*limits(a), *limits(b)))
