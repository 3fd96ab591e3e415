"""What compiled Structured Text calls at run time: arithmetic of fixed widths, checks, strings, conversions.

Integers wrap around like two's complement; division truncates towards zero; REAL rounds to 32 bits after each operation.
What has no result (division by zero, an index outside its array, a root of a negative number) raises `LogicError`, which
stops the task with its outputs safe. Pure.
"""

from __future__ import annotations

import math
import re
import struct
from bisect import bisect_right
from datetime import UTC, datetime, timedelta
from typing import Any

from gateway.core.errors import Blame, FieldtwinError

_FLOAT = struct.Struct("<f")
_WHOLE = re.compile(r"[+-]?[0-9][0-9_]{0,39}", re.ASCII)
_REAL = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)(e[+-]?[0-9]+)?", re.ASCII | re.IGNORECASE)
_NS = 1_000_000_000
MS = 1_000_000
MAX_SHOWN = 60


class LogicError(FieldtwinError):
    """An operation of the program has no result."""

    exit_code = 1
    blame = Blame.FILE


def real(x: float) -> float:
    """Rounded to 32 bits; beyond their range infinite, as IEC 60559 says."""
    try:
        rounded: float = _FLOAT.unpack(_FLOAT.pack(x))[0]
    except OverflowError:
        return math.copysign(math.inf, x)
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
    """The sign is the dividend's; a MOD 0 is 0 (IEC 61131-3, Table 29)."""
    return 0 if b == 0 else a - b * divide(a, b)


def power(a: float, b: float) -> float:
    try:
        result = float(a) ** float(b)  # never of integers, whose powers have no end
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


def steps(first: int, last: int, by: int) -> range:
    if by == 0:
        raise LogicError("a FOR with step 0 would never end")
    return range(first, last + (1 if by > 0 else -1), by)


def copied(x: list[Any]) -> list[Any]:
    """An array of its own: elements that are objects or arrays are copied too."""
    return [copied(e) if isinstance(e, list) else e.copy() if hasattr(e, "copy") else e for e in x]


def shaped(x: list[Any], sizes: tuple[int, ...]) -> list[Any]:
    """The elements of an array of several dimensions from a list of them, the last index changing fastest."""
    for size in reversed(sizes):
        x = [x[i : i + size] for i in range(0, len(x), size)]
    return x


def put(target: Any, source: Any) -> None:
    """Assign a structure: `target` stays the object that it is, since a VAR_IN_OUT may stand for it."""
    for name in target.__slots__:
        setattr(target, name, getattr(source, name))


def with_members(made: Any, **members: Any) -> Any:
    for name, value in members.items():
        setattr(made, name, value)
    return made


# -- bits ---------------------------------------------------------------------------------------------------------------


def set_bit(x: int, bit: int, on: bool) -> int:
    return x | 1 << bit if on else x & ~(1 << bit)


def shift(x: int, n: int, bits: int) -> int:
    """To the left by `n`, to the right if negative; zeros come in."""
    if n < 0:
        return x >> -n
    return (x << n) & ((1 << bits) - 1) if n < bits else 0


def rotate(x: int, n: int, bits: int) -> int:
    n %= bits
    return (x << n | x >> (bits - n)) & ((1 << bits) - 1)


# -- functions ----------------------------------------------------------------------------------------------------------


def of_real(name: str, x: float) -> float:
    """One of math's functions; what has no result is a `LogicError`."""
    try:
        return float(getattr(math, name)(x))
    except OverflowError:
        return math.inf
    except ValueError as e:
        raise LogicError(f"{name} has no value here", got=str(x)) from e


def to_integer(x: float, low: int, high: int) -> int:
    """Rounded to the nearest, ties to the even one (IEC 60559). What does not fit is a `LogicError`."""
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
    """CASE with many labels: which branch has `x`, -1 if none. `lows` in order."""
    at = bisect_right(lows, x) - 1
    return branches[at] if at >= 0 and x <= highs[at] else -1


def pick(selector: int, *choices: Any) -> Any:
    """MUX: a selector outside the choices is a `LogicError`."""
    return choices[index(selector, 0, len(choices) - 1)]


# -- strings: positions count from 1 ------------------------------------------------------------------------------------


def right(s: str, length: int) -> str:
    return s[max(0, len(s) - max(0, length)) :]


def find(s: str, what: str) -> int:
    """0 where it is not, and for an empty one."""
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
    """The character at `position` as a number; 0 where the string has none."""
    return ord(s[position - 1]) if 0 < position <= len(s) else 0


# -- text of values -----------------------------------------------------------------------------------------------------


def real_text(x: float, digits: int) -> str:
    text = f"{x:.{digits}g}"
    return text if "." in text or "e" in text or "n" in text else text + ".0"


def duration_text(ns: int, prefix: str) -> str:
    """``T#1h2m3s4ms``, the largest units first, none that is zero."""
    rest, out = abs(ns), []
    for unit, size in (
        ("d", 86_400 * _NS),
        ("h", 3_600 * _NS),
        ("m", 60 * _NS),
        ("s", _NS),
        ("ms", MS),
        ("us", 1000),
        ("ns", 1),
    ):
        n, rest = divmod(rest, size)
        if n:
            out.append(f"{n}{unit}")
    return f"{prefix}#{'-' if ns < 0 else ''}{''.join(out) or '0s'}"


def date_text(ns: int) -> str:
    return f"D#{_moment(ns):%Y-%m-%d}"


def moment_text(ns: int) -> str:
    return f"DT#{_moment(ns):%Y-%m-%d-%H:%M:%S}"


def tod_text(ns: int) -> str:
    return f"TOD#{_moment(ns):%H:%M:%S}"


def _moment(ns: int) -> datetime:
    try:
        return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=ns // 1000)
    except OverflowError as e:
        raise LogicError("a date outside the calendar", got=f"{ns} ns since 1970") from e


def number_of(text: str, low: int, high: int) -> int:
    """STRING_TO_integer: spaces around are ignored; what is no number is a `LogicError`."""
    digits = text.strip()
    if not _WHOLE.fullmatch(digits):
        raise LogicError("a string that is no whole number", got=repr(text[:MAX_SHOWN]))
    value = int(digits.replace("_", ""))
    if low <= value <= high:
        return value
    raise LogicError("a value that does not fit its type", expected=f"{low} to {high}", got=str(value))


def real_of(text: str) -> float:
    if not _REAL.fullmatch(text.strip()):
        raise LogicError("a string that is no number", got=repr(text[:MAX_SHOWN]))
    return float(text)
