"""The functions that compiled Structured Text calls at run time: arithmetic of fixed widths, checks, strings, conversions.

Integers wrap around like two's complement; division truncates towards zero; REAL rounds to 32 bits after each operation. An
operation without a result (division by zero, an index outside its array, a root of a negative number) raises `LogicError`,
which stops the task with its outputs at their safe values.
"""

from __future__ import annotations

import math
import re
import struct
from bisect import bisect_right
from collections.abc import Callable, Iterator
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.plc.st.runtime import copying, layouts
from fieldtwin.plc.st.runtime.arrays import OpenArray, bound
from fieldtwin.plc.st.runtime.layouts import Stored
from fieldtwin.plc.st.runtime.lines import (
    NO_LINES,
    ElementLines,
    RowLines,
    assigned_array,
    assigned_whole,
    hand_lines,
    lent,
    lines_in,
)
from fieldtwin.plc.st.runtime.logic_error import LogicError
from fieldtwin.plc.st.runtime.moments import (
    date_of,
    date_text,
    day_of_week,
    dt_of,
    moment_text,
    split_date,
    split_dt,
    split_tod,
    tod_of,
    tod_text,
)
from fieldtwin.plc.st.runtime.references import (
    Cell,
    Characters,
    Cut,
    Element,
    Instance,
    Letters,
    MemberReference,
    Whole,
    attempted,
    characters,
    cut,
    first,
    from_beginning,
    instance,
    memory,
    moved,
    pointed,
    queried,
    same,
    view,
    whole,
)

__all__ = [  # and all names that compiled code calls
    "NO_LINES",
    "Cell",
    "Characters",
    "Cut",
    "Element",
    "ElementLines",
    "Instance",
    "Letters",
    "LogicError",
    "MemberReference",
    "OpenArray",
    "RowLines",
    "Whole",
    "assigned_array",
    "assigned_whole",
    "attempted",
    "bound",
    "characters",
    "copying",
    "cut",
    "date_of",
    "date_text",
    "day_of_week",
    "dt_of",
    "first",
    "from_beginning",
    "hand_lines",
    "instance",
    "layouts",
    "lent",
    "lines_in",
    "memory",
    "moment_text",
    "moved",
    "pointed",
    "queried",
    "same",
    "split_date",
    "split_dt",
    "split_tod",
    "tod_of",
    "tod_text",
    "view",
    "whole",
]

SINGLE = struct.Struct("f")
"""A 32-bit float in the computer's own form, whose rounding gives infinity beyond the range."""
_WHOLE = re.compile(r"[+-]?[0-9][0-9_]{0,39}", re.ASCII)
_LEADING_NUMBER = re.compile(r"\s*((2|8|16)#[0-9a-f][0-9a-f_]{0,79}|[+-]?[0-9][0-9_]{0,39})", re.ASCII | re.IGNORECASE)
_LEADING_REAL = re.compile(r"\s*[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)(e[+-]?[0-9]+)?", re.ASCII | re.IGNORECASE)
_BASED = re.compile(r"(2|8|16)#([0-9a-f][0-9a-f_]{0,79})", re.ASCII | re.IGNORECASE)
_REAL = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)(e[+-]?[0-9]+)?", re.ASCII | re.IGNORECASE)
MAX_SHOWN = 60


def real(x: float) -> float:
    """Return `x` rounded to a 32-bit float, or infinity beyond its range, as IEC 60559 requires."""
    rounded: float = SINGLE.unpack(SINGLE.pack(x))[0]
    return rounded


def signed(x: int, bits: int) -> int:
    half = 1 << (bits - 1)
    return ((x + half) & ((1 << bits) - 1)) - half


def divide(a: int, b: int) -> int:
    if b == 0:
        raise LogicError("division by zero")
    q = abs(a) // abs(b)
    return q if (a < 0) == (b < 0) else -q


def divide_real(a: float, b: float) -> float:
    if b == 0:
        raise LogicError("division by zero")
    return a / b


def modulo(a: int, b: int) -> int:
    """Return the remainder, with the sign of the dividend; a MOD 0 is 0 (IEC 61131-3, Table 29)."""
    return 0 if b == 0 else a - b * divide(a, b)


def power(a: float, b: float) -> float:
    try:
        result = float(a) ** float(b)  # never of integers, whose powers can grow without limit
    except OverflowError:
        return math.inf
    except ZeroDivisionError as e:
        raise LogicError("zero to a negative power") from e
    if isinstance(result, complex):
        raise LogicError("a root of a negative number", got=f"{a} ** {b}")
    return float(result)


def index(i: int, low: int, high: int) -> int:
    if low <= i <= high:
        return i - low
    raise LogicError("an index outside its array", expected=f"{low} to {high}", got=str(i))


def inside(x: int, low: int, high: int) -> int:
    if low <= x <= high:
        return x
    raise LogicError("a value outside its subrange", expected=f"{low} to {high}", got=str(x))


def enumerated(x: int, values: tuple[int, ...], name: str) -> int:
    if x in values:
        return x
    raise LogicError(f"a number that is not a value of {name}", expected=", ".join(map(str, values)), got=str(x))


def steps(first: int, last: int, by: int) -> range:
    if by == 0:
        raise LogicError("a FOR with step 0 would never end")
    return range(first, last + (1 if by > 0 else -1), by)


def beyond(taken: range) -> int:
    """Return the value of a FOR's control variable after the loop: the first value past the limit, or the initial value
    if the loop did not run."""
    return taken[-1] + taken.step if taken else taken.start


def unaltered(taken: range, control: Callable[[], int]) -> Iterator[int]:
    """Yield the values of a FOR's control variable, and raise `LogicError` if a POU that the loop called has changed the
    variable.
    """
    for value in taken:
        yield value
        if control() != value:
            raise LogicError(
                "the control variable of a FOR was altered in the loop", expected=str(value), got=str(control())
            )


def following(taken: range, control: Callable[[], int]) -> Iterator[int]:
    """Yield the values of a FOR's control variable that the loop alters: each one is its present value plus the step."""
    value = taken.start
    while value < taken.stop if taken.step > 0 else value > taken.stop:
        yield value
        value = control() + taken.step


def copied(x: list[Any]) -> list[Any]:
    """Return a copy of an array; elements that are objects or arrays are copied too."""
    return [copied(e) if isinstance(e, list) else e.copy() if hasattr(e, "copy") else e for e in x]


def shaped(x: list[Any], sizes: tuple[int, ...]) -> list[Any]:
    """Return the elements of an array of several dimensions from a flat list of them, the last index changing
    fastest."""
    for size in reversed(sizes):
        x = [x[i : i + size] for i in range(0, len(x), size)]
    return x


def put(target: Any, source: Any) -> None:
    """Assign a structure in place: `target` and the objects inside it stay the same objects, because a VAR_IN_OUT may
    refer to them. `source` is a copy."""
    if isinstance(target, Stored):
        target.assign(source)
        return
    for name in target.__slots__:
        held = getattr(target, name)
        if isinstance(held, list):
            fill(held, getattr(source, name))
        elif hasattr(held, "copy"):
            put(held, getattr(source, name))
        else:
            setattr(target, name, getattr(source, name))


def fill(target: list[Any], source: list[Any]) -> None:
    """Assign an array in place, as `put` does."""
    if isinstance(target, Stored):
        target.assign(source)
        return
    if target and not isinstance(target[0], list) and not hasattr(target[0], "copy"):
        target[:] = source
        return
    for held, new in zip(target, source, strict=True):
        if isinstance(held, list):
            fill(held, new)
        else:
            put(held, new)


def with_members(made: Any, **members: Any) -> Any:
    for name, value in members.items():
        setattr(made, name, value)
    return made


def with_properties(made: Any, **setters: Any) -> Any:
    """Return a new instance after a call of each of its methods `setters` with a value."""
    for name, value in setters.items():
        getattr(made, name)(value)
    return made


# -- bits ---------------------------------------------------------------------------------------------------------------


def set_part(x: int, first: int, bits: int, part: int) -> int:
    """Return `x` with `part` in place of its `bits` bits from bit `first` on."""
    return x & ~((1 << bits) - 1 << first) | part << first


def shift_left(x: int, n: int, bits: int) -> int:
    """Return `x` shifted left, with zeros from the right (SHL). A negative count is an error (IEC 61131-3, Table 30)."""
    return (x << _count(n)) & ((1 << bits) - 1) if n < bits else 0


def shift_right(x: int, n: int, bits: int) -> int:
    """Return `x` shifted right, with zeros from the left (SHR). A negative count is an error."""
    return x >> _count(n) if n < bits else 0


def rotate_left(x: int, n: int, bits: int) -> int:
    n = _count(n) % bits
    return (x << n | x >> (bits - n)) & ((1 << bits) - 1)


def rotate_right(x: int, n: int, bits: int) -> int:
    return rotate_left(x, bits - _count(n) % bits, bits)


def arithmetic_right(x: int, n: int) -> int:
    """Return a signed integer shifted right, with copies of its sign from the left. A negative count is an error."""
    return x >> min(_count(n), 64)


def _count(n: int) -> int:
    if n < 0:
        raise LogicError("a negative count of a shift or a rotation", expected="0 or more", got=str(n))
    return n


def of_bcd(x: int, high: int) -> int:
    """Return the number whose decimal digits are the hexadecimal digits of `x`. Raises `LogicError` for A to F, or
    above `high`."""
    digits = f"{x:x}"
    if not digits.isdecimal():
        raise LogicError("a bit string that is not binary coded decimal", got=f"16#{digits.upper()}")
    if (number := int(digits)) > high:
        raise LogicError("a value that does not fit its type", expected=f"0 to {high}", got=digits)
    return number


def to_bcd(x: int, bits: int) -> int:
    """Return the decimal digits of `x`, four bits each. Raises `LogicError` if `bits` cannot hold them."""
    if not 0 <= x < 10 ** (bits // 4):
        raise LogicError("a value that does not fit its type", expected=f"0 to {10 ** (bits // 4) - 1}", got=str(x))
    return int(str(x), 16)


# -- functions ----------------------------------------------------------------------------------------------------------


def of_real(name: str, x: float) -> float:
    """Return the result of function `name` of `math` for `x`; infinity if it overflows. Raises `LogicError` if it has none."""
    try:
        return float(getattr(math, name)(x))
    except OverflowError:
        return math.inf
    except ValueError as e:
        raise LogicError(f"{name} has no value here", got=str(x)) from e


def to_integer(x: float, low: int, high: int) -> int:
    """Return `x` rounded to the nearest integer, ties to even (IEC 60559). Raises `LogicError` if it does not fit."""
    if math.isfinite(x) and low <= (whole := round(x)) <= high:
        return whole
    raise LogicError("a value that does not fit its type", expected=f"{low} to {high}", got=str(x))


def truncated(x: float, low: int, high: int) -> int:
    if math.isfinite(x) and low <= (whole := math.trunc(x)) <= high:
        return whole
    raise LogicError("a value that does not fit its type", expected=f"{low} to {high}", got=str(x))


def time_times(ns: int, factor: float) -> int:
    return to_integer(ns * factor, -(2**63), 2**63 - 1)


def time_over(ns: int, divisor: float) -> int:
    return to_integer(divide_real(ns, divisor), -(2**63), 2**63 - 1)


def branch(x: int, lows: tuple[int, ...], highs: tuple[int, ...], branches: tuple[int, ...]) -> int:
    """Return the branch of a CASE with many labels for `x`, or -1. `lows` are in ascending order."""
    at = bisect_right(lows, x) - 1
    return branches[at] if at >= 0 and x <= highs[at] else -1


def pick(selector: int, *choices: Any) -> Any:
    """Return the choice that the selector of a MUX selects. Raises `LogicError` for a selector without a choice."""
    return choices[index(selector, 0, len(choices) - 1)]


# -- strings: positions count from 1 ------------------------------------------------------------------------------------


def right(s: str, length: int) -> str:
    return s[max(0, len(s) - max(0, length)) :]


def find(s: str, what: str) -> int:
    """Return the position of `what` in `s`, from 1; 0 if it is not found, or if `what` is empty."""
    return s.find(what) + 1 if what else 0


def mid(s: str, length: int, position: int) -> str:
    return s[position - 1 : position - 1 + length] if length > 0 and position > 0 else ""


def inserted(s: str, what: str, position: int) -> str:
    return s[: max(0, position)] + what + s[max(0, position) :]


def deleted(s: str, length: int, position: int) -> str:
    return s if length <= 0 or position <= 0 else s[: position - 1] + s[position - 1 + length :]


def replaced(s: str, what: str, length: int, position: int) -> str:
    return s if position <= 0 else s[: position - 1] + what + s[position - 1 + max(0, length) :]


def code_of(s: str, position: int) -> int:
    """Return the character at `position` as a number; 0 if the string is shorter."""
    return ord(s[position - 1]) if 0 < position <= len(s) else 0


# -- text of values -----------------------------------------------------------------------------------------------------


def real_text(x: float, digits: int) -> str:
    text = f"{x:.{digits}g}"
    return text if "." in text or "e" in text or "n" in text else text + ".0"


def duration_text(ns: int, prefix: str) -> str:
    """Return a duration as a literal such as ``T#1h2m3s4ms``: the largest units first, without units that are zero."""
    rest, out = abs(ns), []
    for unit, size in (
        ("d", 86_400 * NS_PER_S),
        ("h", 3_600 * NS_PER_S),
        ("m", 60 * NS_PER_S),
        ("s", NS_PER_S),
        ("ms", NS_PER_MS),
        ("us", 1000),
        ("ns", 1),
    ):
        n, rest = divmod(rest, size)
        if n:
            out.append(f"{n}{unit}")
    return f"{prefix}#{'-' if ns < 0 else ''}{''.join(out) or '0s'}"


def number_of(text: str, low: int, high: int) -> int:
    """Return the number that a string holds as a literal: ``-12``, ``1_000``, ``16#FF``, ``2#1010``; spaces around it
    are ignored. Raises `LogicError` for a text that is not a number or does not fit."""
    digits = text.strip()
    based = _BASED.fullmatch(digits)
    try:
        if based is None and not _WHOLE.fullmatch(digits):
            raise ValueError(digits)
        base = int(based.group(1)) if based else 10
        value = int((based.group(2) if based else digits).replace("_", ""), base)
    except ValueError:
        raise LogicError("a string that is not a whole number", got=repr(text[:MAX_SHOWN])) from None
    if low <= value <= high:
        return value
    raise LogicError("a value that does not fit its type", expected=f"{low} to {high}", got=str(value))


def leading_number(text: str, low: int, high: int) -> int:
    """Return the number with which a string begins, as CODESYS converts it: 12 for ``12abc``, 3 for ``3.14``, 0 without a
    number.

    Raises `LogicError` for a number that does not fit.
    """
    found = _LEADING_NUMBER.match(text)
    return number_of(found[0], low, high) if found is not None else 0


def leading_real(text: str) -> float:
    """Return the number with which a string begins, 0 without a number."""
    found = _LEADING_REAL.match(text)
    return float(found[0]) if found is not None else 0.0


def real_of(text: str) -> float:
    if not _REAL.fullmatch(text.strip()):
        raise LogicError("a string that is not a number", got=repr(text[:MAX_SHOWN]))
    return float(text)
