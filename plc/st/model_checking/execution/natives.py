"""Models of the functions that compiled code calls and whose Python code is not executed symbolically.

They need a library, such as ``math``, or there is a shorter formula for them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import z3

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st import values
from fieldtwin.plc.st.model_checking.execution import floats, operations
from fieldtwin.plc.st.model_checking.execution.mailboxes import Mailbox
from fieldtwin.plc.st.model_checking.execution.merging import merged, options_of
from fieldtwin.plc.st.model_checking.execution.operations import binary, compare, extreme, is_known, truth
from fieldtwin.plc.st.model_checking.execution.refusal import NotModelled
from fieldtwin.plc.st.model_checking.execution.symbolic import (
    TEXT,
    UNDEFINED,
    Condition,
    Int,
    Undefined,
    both,
    is_integer,
    negated,
)


class Evaluation(Protocol):
    """The part of `fieldtwin.plc.st.model_checking.execution.evaluation.Evaluation` that models use."""

    def fail_if(self, condition: Condition, message: str) -> None: ...

    def unknown(self, what: str) -> floats.Float: ...

    def unknown_condition(self, what: str) -> Condition: ...

    def unknown_integer(self, what: str, low: int, high: int) -> Int | int: ...

    def attribute(self, owner: Any, name: str) -> Any: ...

    def put_attribute(self, owner: Any, name: str, value: Any) -> None: ...


Model = Callable[[Evaluation, tuple[Any, ...]], Any]


@dataclass(frozen=True, slots=True)
class SymbolicRange:
    """A range whose limits are not known. `step` is known and is not 0."""

    start: Any
    stop: Any
    step: int


def number_range(x: Evaluation, given: tuple[Any, ...]) -> Any:
    """Return ``range(...)``."""
    if all(map(is_known, given)):
        return range(*given)
    start, stop = (0, given[0]) if len(given) == 1 else given[:2]
    step = given[2] if len(given) > 2 else 1
    if not isinstance(step, int):
        raise NotModelled("a FOR whose step is not constant")
    return SymbolicRange(start, stop, step)


def _real(x: Evaluation, given: tuple[Any, ...]) -> Any:
    value = given[0]
    if isinstance(value, Undefined):
        return value
    return floats.rounded(floats.of_integer(value) if is_integer(value) else value)


def _whole(cut: bool) -> Model:
    def model(x: Evaluation, given: tuple[Any, ...]) -> Any:
        value, low, high = given
        if isinstance(value, Undefined):
            return value
        if isinstance(value, Int):
            value = floats.of_integer(value)
        inside, whole = floats.to_integer(value, low, high, cut)
        x.fail_if(negated(inside), "a value that does not fit its type")
        return whole

    return model


def _unknown(what: str) -> Model:
    return lambda x, given: UNDEFINED if UNDEFINED in given else x.unknown(what)


def _of_real(x: Evaluation, given: tuple[Any, ...]) -> Any:
    name, value = given
    if name != "sqrt" or not isinstance(value, floats.Float):
        return x.unknown(name.upper())
    x.fail_if(floats.compare_floats("<", value, 0.0), "SQRT of a negative number")
    return floats.Float(z3.fpSqrt(floats.nearest(), floats.double(value)))


def _steps(x: Evaluation, given: tuple[Any, ...]) -> Any:
    first, last, by = given
    if not isinstance(by, int):
        raise NotModelled("a FOR whose step is not constant")
    if by == 0:
        x.fail_if(True, "a FOR with step 0 would never end")
        return range(0)
    return number_range(x, (first, binary("+", last, 1 if by > 0 else -1), by))


def _beyond(x: Evaluation, given: tuple[Any, ...]) -> Any:
    taken = given[0]
    if isinstance(taken, range):
        return values.beyond(taken)
    size, sign = abs(taken.step), 1 if taken.step > 0 else -1
    distance = binary("*", binary("-", taken.stop, taken.start), sign)
    count = binary("//", extreme(">", [binary("+", distance, size - 1), 0]), size)
    return binary("+", taken.start, binary("*", count, taken.step))


def _branch(x: Evaluation, given: tuple[Any, ...]) -> Any:
    selector, lows, highs, branches = given
    result: Any = -1
    for low, high, number in zip(lows, highs, branches, strict=True):
        result = merged(_between(selector, low, high), number, result)
    return result


def _to_bcd(x: Evaluation, given: tuple[Any, ...]) -> Any:
    value, bits = given
    digits = bits // 4
    x.fail_if(negated(_between(value, 0, 10**digits - 1)), "a value that does not fit its type")
    result: Any = 0
    for n in range(digits):
        digit = binary("%", binary("//", value, 10**n), 10)
        result = binary("|", result, binary("<<", digit, 4 * n))
    return result


def _of_bcd(x: Evaluation, given: tuple[Any, ...]) -> Any:
    value, high = given
    result: Any = 0
    for n in range(16):
        digit = binary("&", binary(">>", value, 4 * n), 15)
        x.fail_if(compare(">", digit, 9), "a bit string that is not binary coded decimal")
        result = binary("+", result, binary("*", digit, 10**n))
    x.fail_if(compare(">", result, high), "a value that does not fit its type")
    return binary("&", result, high)  # the highest value of each unsigned type is a mask


def _between(value: Any, low: int, high: int) -> Any:
    return both(compare("<=", low, value), compare("<=", value, high))


def _boolean(x: Evaluation, given: tuple[Any, ...]) -> Any:
    return truth(given[0])


def _integer(x: Evaluation, given: tuple[Any, ...]) -> Any:
    return binary("+", given[0], 0)


def _floating(x: Evaluation, given: tuple[Any, ...]) -> Any:
    value = given[0]
    if isinstance(value, z3.BoolRef):
        value = merged(value, 1, 0)
    return floats.of_integer(value) if is_integer(value) else value


def _length(x: Evaluation, given: tuple[Any, ...]) -> Any:
    result: Any = UNDEFINED
    for condition, option in options_of(given[0]):
        known = isinstance(option, list | tuple | str)
        found = (
            option.count
            if isinstance(option, Mailbox)
            else len(option)
            if known
            else x.unknown_integer("the length of a STRING", 0, ty.MAX_STRING)
        )
        result = merged(condition, found, result)
    return result


def _finite(x: Evaluation, given: tuple[Any, ...]) -> Any:
    return True if isinstance(given[0], Int) else floats.is_finite(given[0])


def _any(x: Evaluation, given: tuple[Any, ...]) -> Any:
    result: Any = False
    for value in given[0]:
        result = binary("|", result, truth(value))
    return result


def _extreme(op: str) -> Model:
    return lambda x, given: extreme(op, given if len(given) > 1 else given[0])


def _text(x: Evaluation, given: tuple[Any, ...]) -> Any:
    return UNDEFINED if any(isinstance(each, Undefined) for each in given) else TEXT


def _whole_number_of_text(x: Evaluation, given: tuple[Any, ...]) -> Any:
    _, low, high = given
    x.fail_if(x.unknown_condition("the conversion of a STRING"), "a string that is not a whole number")
    return x.unknown_integer("the conversion of a STRING", low, high)


def _number_of_text(x: Evaluation, given: tuple[Any, ...]) -> Any:
    x.fail_if(x.unknown_condition("the conversion of a STRING"), "a string that is not a number")
    return x.unknown("the conversion of a STRING")


def _character(what: str) -> Model:
    return lambda x, given: x.unknown_integer(what, 0, 65_535)


OF_VALUES: dict[str, Model] = {
    "real": _real, "to_integer": _whole(cut=False), "truncated": _whole(cut=True), "power": _unknown("the power **"),
    "of_real": _of_real, "steps": _steps, "beyond": _beyond, "branch": _branch,
    "to_bcd": _to_bcd, "of_bcd": _of_bcd, "mid": _text, "right": _text, "inserted": _text, "deleted": _text, "replaced": _text,
    "real_text": _text, "duration_text": _text, "date_text": _text, "moment_text": _text, "tod_text": _text,
    "number_of": _whole_number_of_text, "real_of": _number_of_text, "code_of": _character("ASC"),
    "find": lambda x, given: x.unknown_integer("FIND", 0, ty.MAX_STRING),
}  # fmt: skip
"""Models of functions of `fieldtwin.plc.st.values` and `fieldtwin.plc.st.runtime.moments`, by name."""
BUILTINS: dict[str, Model] = {
    "range": number_range, "bool": _boolean, "int": _integer, "float": _floating, "len": _length, "isfinite": _finite,
    "any": _any, "min": _extreme("<"), "max": _extreme(">"), "abs": lambda x, given: operations.absolute(given[0]),
    "zip": lambda x, given: list(zip(*given, strict=True)), "hasattr": lambda x, given: hasattr(*given),
    "isinstance": lambda x, given: isinstance(*given), "getattr": lambda x, given: x.attribute(*given),
    "setattr": lambda x, given: x.put_attribute(*given), "atan2": _unknown("ATAN2"),
    "str": _text, "chr": _text, "ord": _character("the number of a character"),
}  # fmt: skip
"""Models of functions of Python, by name."""
