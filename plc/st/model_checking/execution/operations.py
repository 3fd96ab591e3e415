"""The operators of Python on symbolic values, as compiled programs and function blocks use them."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable
from typing import Any

import z3

from fieldtwin.plc.st.model_checking.execution import floats, symbolic
from fieldtwin.plc.st.model_checking.execution.merging import merged, options_of
from fieldtwin.plc.st.model_checking.execution.refusal import NotModelled
from fieldtwin.plc.st.model_checking.execution.symbolic import (
    TEXT,
    UNDEFINED,
    Choice,
    Condition,
    Int,
    Text,
    Undefined,
    as_condition,
    both,
    either,
    is_condition,
    is_integer,
    negated,
)

PLAIN: dict[str, Callable[[Any, Any], Any]] = {
    "+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv, "**": operator.pow, "//": operator.floordiv,
    "%": operator.mod, "&": operator.and_, "|": operator.or_, "^": operator.xor, "<<": operator.lshift, ">>": operator.rshift,
    "==": operator.eq, "!=": operator.ne, "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge,
}  # fmt: skip
_OF_INTEGERS: dict[str, Callable[[Any, Any], Any]] = {
    "+": symbolic.add, "-": symbolic.subtract, "*": symbolic.multiply, "//": symbolic.floor_divide,
    "%": symbolic.floor_modulo, "&": symbolic.bit_and, "|": symbolic.bit_or, "^": symbolic.bit_xor,
    "<<": symbolic.shift_left, ">>": symbolic.shift_right,
}  # fmt: skip
_OF_CONDITIONS: dict[str, Callable[[Any, Any], Any]] = {
    "&": both,
    "|": either,
    "^": lambda a, b: z3.Xor(as_condition(a), as_condition(b)),
}
STRINGS = "this operation on a STRING that depends on inputs or on the state"


def is_known(value: Any) -> bool:
    """Return whether `value` is plain data of Python, without a symbolic part."""
    if isinstance(value, tuple):
        return all(map(is_known, value))
    return value is None or isinstance(value, bool | int | float | str | bytes | range)


def is_text(value: Any) -> bool:
    """Return whether `value` is a text, known or not, or one of several texts."""
    return all(isinstance(option, str | Text) for _, option in options_of(value))


def is_unknown_text(value: Any) -> bool:
    """Return whether `value` can be a text that is not known."""
    return any(isinstance(option, Text) for _, option in options_of(value))


def truth(value: Any) -> Condition:
    """Return ``bool(value)`` of Python."""
    if isinstance(value, Undefined) or value is None:
        return False
    if is_condition(value):
        return value
    if isinstance(value, Int):
        return symbolic.compare("!=", value, 0)
    if isinstance(value, Choice):
        return either(*(both(condition, truth(option)) for condition, option in value.options))
    if isinstance(value, floats.Float):
        return floats.compare_floats("!=", value, 0.0)
    return bool(value)


def _number(value: Any) -> Any:
    """Return a condition as the integer 0 or 1, and other values unchanged."""
    return symbolic.merged_integers(value, 1, 0) if isinstance(value, z3.BoolRef) else value


def _as_float(value: Any) -> Any:
    return floats.of_integer(value) if is_integer(value) else value


def binary(op: str, a: Any, b: Any) -> Any:
    """Return ``a op b``."""
    if isinstance(a, Undefined) or isinstance(b, Undefined):
        return UNDEFINED
    if is_known(a) and is_known(b):
        return PLAIN[op](a, b)
    if isinstance(a, Choice) or isinstance(b, Choice):
        return _over_options(a, b, lambda x, y: UNDEFINED if x is None or y is None else binary(op, x, y))
    if is_condition(a) and is_condition(b) and op in _OF_CONDITIONS:
        return _OF_CONDITIONS[op](a, b)
    a, b = _number(a), _number(b)
    if is_integer(a) and is_integer(b):
        if op in _OF_INTEGERS:
            return _OF_INTEGERS[op](a, b)
        if not floats.exact_division(a, b):
            raise NotModelled("the division of a whole number above 2**53 as a real number")
    elif op == "+" and is_text(a) and is_text(b):
        return TEXT
    elif is_text(a) or is_text(b):
        raise NotModelled(STRINGS)
    elif not all(is_integer(x) or floats.is_float(x) for x in (a, b)):
        raise NotModelled(f"the operator {op} of such values")
    return floats.operation(op, _as_float(a), _as_float(b))


def compare(op: str, a: Any, b: Any) -> Condition:
    """Return the condition ``a op b``."""
    if isinstance(a, Undefined) or isinstance(b, Undefined):
        return False
    if is_known(a) and is_known(b):
        return PLAIN[op](a, b)
    if isinstance(a, Choice) or isinstance(b, Choice):
        found = _over_options(a, b, lambda x, y: False if x is None or y is None else compare(op, x, y))
        return False if isinstance(found, Undefined) else found
    if is_condition(a) and is_condition(b) and op in ("==", "!="):
        different = z3.Xor(as_condition(a), as_condition(b))
        return different if op == "!=" else z3.Not(different)
    a, b = _number(a), _number(b)
    if is_integer(a) and is_integer(b):
        return symbolic.compare(op, a, b)
    if is_text(a) or is_text(b):
        raise NotModelled(STRINGS)
    if not all(is_integer(x) or floats.is_float(x) for x in (a, b)):
        raise NotModelled(f"the comparison {op} of such values")
    if any(isinstance(x, Int) and max(-x.low, x.high) > floats.EXACT for x in (a, b)):
        raise NotModelled("the comparison of a whole number above 2**53 with a real number")
    return floats.compare_floats(op, _as_float(a), _as_float(b))


def _over_options(a: Any, b: Any, function: Callable[[Any, Any], Any]) -> Any:
    result: Any = UNDEFINED
    for first, x in options_of(a):
        for second, y in options_of(b):
            result = merged(both(first, second), function(x, y), result)
    return result


def is_none(value: Any) -> Condition:
    return either(*(condition for condition, option in options_of(value) if option is None))


def unary(op: str, value: Any) -> Any:
    """Return ``-value``, ``~value`` or ``not value``."""
    if isinstance(value, Undefined):
        return UNDEFINED
    if op == "not":
        return negated(truth(value))
    if isinstance(value, Choice):
        return _over_options(value, 0, lambda x, _: UNDEFINED if x is None else unary(op, x))
    value = _number(value)
    if op == "~":
        return symbolic.subtract(-1, value)
    if is_integer(value):
        return symbolic.negative(value)
    return -value if isinstance(value, float) else floats.negative(value)


def absolute(value: Any) -> Any:
    if isinstance(value, Undefined) or is_known(value):
        return UNDEFINED if isinstance(value, Undefined) else abs(value)
    if not isinstance(value, Int):
        return floats.absolute(value)
    if value.low >= 0:
        return value
    if value.high <= 0:
        return symbolic.negative(value)
    found = symbolic.merged_integers(symbolic.compare("<", value, 0), symbolic.negative(value), value)
    return symbolic.made(found.expr, 0, max(-value.low, value.high)) if isinstance(found, Int) else found


def extreme(op: str, values: Iterable[Any]) -> Any:
    """Return ``min(values)`` (`op` is ``<``) or ``max(values)`` (``>``): a later value is taken only if it is less or greater."""
    first, *rest = values
    for value in rest:
        taken = merged(compare(op, value, first), value, first)
        if isinstance(taken, Int) and is_integer(value) and is_integer(first):
            (a, b), (c, d) = symbolic.limits(value), symbolic.limits(first)
            low, high = (min(a, c), min(b, d)) if op == "<" else (max(a, c), max(b, d))
            taken = symbolic.made(taken.expr, low, high)
        first = taken
    return first


def item(values: list[Any] | tuple[Any, ...], index: Any) -> Any:
    """Return ``values[index]``. An index outside is excluded before by the program's own check."""
    if not isinstance(index, Int):
        return values[index] if isinstance(index, int) and -len(values) <= index < len(values) else UNDEFINED
    result: Any = UNDEFINED
    for n in range(max(0, index.low), min(len(values) - 1, index.high) + 1):
        result = merged(symbolic.compare("==", index, n), values[n], result)
    return result
