"""The meaning of literals: value and type. Raises `Malformed` with the reason; the caller adds the position."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction
from math import isfinite
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.syntax.tree import Literal
from fieldtwin.plc.st.values import real

_UNITS_NS = {
    "d": 86_400_000_000_000, "h": 3_600_000_000_000, "m": 60_000_000_000, "s": 1_000_000_000, "ms": 1_000_000,
    "us": 1_000, "ns": 1,
}  # fmt: skip
_PART = re.compile(r"([0-9_]+(?:\.[0-9]+)?)(d|h|ms|us|ns|m|s)_?", re.IGNORECASE)
_ESCAPES = {"$": "$", "'": "'", '"': '"', "L": "\n", "N": "\n", "P": "\f", "R": "\r", "T": "\t"}


class Malformed(ValueError):
    """A literal without a valid meaning."""


@dataclass(frozen=True, slots=True)
class Constant:
    value: Any
    type: ty.Type


def constant(literal: Literal) -> Constant:
    """Return the value and type of any literal except an enumerated one. Raises `Malformed`."""
    try:
        found = _constant(literal.kind, literal.text)
    except Malformed:
        raise
    except ValueError as e:  # more digits than Python converts
        raise Malformed("more digits than any type holds") from e
    if isinstance(found.value, float) and not isfinite(found.value):
        raise Malformed("a number beyond the range of its type")
    if isinstance(found.value, int) and not -(2**63) <= found.value < 2**64:
        raise Malformed("a whole number that no type holds")
    return found


def _constant(kind: str, text: str) -> Constant:
    if kind == "INTEGER":
        value = int(text.replace("_", ""))
        return Constant(value, ty.AnyInt(value))
    if kind == "REAL":
        number = float(text.replace("_", ""))
        return Constant(number, ty.AnyReal(number))
    if kind in ("TRUE", "FALSE"):
        return Constant(kind == "TRUE", ty.BOOL)
    if kind == "BASED":
        return _based(text)
    if kind == "TYPED":
        return _typed(text)
    if kind == "DURATION":
        return _duration(text)
    if kind in ("STRING_LITERAL", "WSTRING_LITERAL"):
        return _string(text, wide=kind.startswith("W"))
    if kind == "TYPED_TEXT":
        return _typed_text(text)
    return _moment(kind, text)


def _typed_text(text: str) -> Constant:
    """Return a literal such as ``CHAR#'A'`` or ``STRING#'OK'`` (table 7)."""
    name, _, quoted = text.partition("#")
    found = _string(quoted, wide=quoted.startswith('"'))
    if name.upper() in ("STRING", "WSTRING"):
        return found
    if len(found.value) != 1:
        raise Malformed(f"a {name.upper()} is one character")
    return Constant(found.value, ty.ELEMENTARY[name.upper()])


def _based(text: str) -> Constant:
    *name, base, digits = text.replace("_", "").split("#")
    try:
        value = int(digits, int(base))
    except ValueError as e:
        raise Malformed(f"a digit that base {base} does not have") from e
    return _of_type(name[0], value) if name else Constant(value, ty.AnyInt(value))


def _typed(text: str) -> Constant:
    name, _, number = text.replace("_", "").partition("#")
    if name.upper() == "BOOL":
        return Constant(number.upper() in ("TRUE", "1"), ty.BOOL)
    target = ty.ELEMENTARY[name.upper()]
    if target.kind == "real":
        value = float(number)
        return Constant(real(value) if target.bits == 32 else value, target)
    if not re.fullmatch(r"[+-]?[0-9]+", number):
        raise Malformed(f"{target} takes whole numbers")
    return _of_type(name, int(number))


def _of_type(name: str, value: int) -> Constant:
    target = ty.ELEMENTARY.get(name.upper())
    if target is None or target.kind not in ("int", "bits", "bool"):
        raise Malformed(f"{name} is not an integer or bit string type")
    if not target.low <= value <= target.high:
        raise Malformed(f"{target} holds {target.low} to {target.high}")
    return Constant(bool(value) if target.kind == "bool" else value, target)


def _duration(text: str) -> Constant:
    name, _, amount = text.partition("#")
    amount = amount.replace("_", "") if "." not in amount else amount
    total, order = Fraction(0), len(_UNITS_NS)
    units = list(_UNITS_NS)
    parts = _PART.findall(amount.lstrip("+-"))
    for n, (number, unit) in enumerate(parts):
        place = units.index(unit.lower())
        if len(units) - place > order or (n and len(units) - place == order):
            raise Malformed("units of a duration go from the largest to the smallest, each once")
        order = len(units) - place
        if "." in number and n != len(parts) - 1:
            raise Malformed("only the last unit of a duration may have a fraction")
        total += Fraction(number.replace("_", "")) * _UNITS_NS[unit.lower()]
    value = int(total) * (-1 if amount.startswith("-") else 1)
    if not ty.TIME.low <= value <= ty.TIME.high:
        raise Malformed("a duration of more than 292 years")
    return Constant(value, ty.LTIME if name.upper() in ("LT", "LTIME") else ty.TIME)


def _string(text: str, wide: bool) -> Constant:
    digits, out, i = 4 if wide else 2, [], 1
    while i < len(text) - 1:
        char = text[i]
        i += 1
        if char == "$":
            escape = text[i].upper()
            if escape in _ESCAPES:
                char, i = _ESCAPES[escape], i + 1
            else:
                try:
                    char, i = chr(int(text[i : i + digits], 16)), i + digits
                except ValueError as e:
                    raise Malformed(f"${text[i]} is not an escape: $$ $' $L $N $P $R $T or {digits} hex digits") from e
        if not wide and ord(char) > 255:
            raise Malformed('a STRING holds characters of one byte; write a WSTRING ("...")')
        out.append(char)
    if len(out) > ty.MAX_STRING:
        raise Malformed(f"a string of more than {ty.MAX_STRING} characters")
    return Constant("".join(out), ty.String(max(1, len(out)), wide))


def _moment(kind: str, text: str) -> Constant:
    numbers = re.split(r"[-:]", text.partition("#")[2])
    seconds = Fraction(numbers.pop()) if kind != "DATE" and len(numbers) in (3, 6) else Fraction(0)
    whole = [int(n) for n in numbers]
    try:
        year, month, day = (1970, 1, 1) if kind == "TIME_OF_DAY" else whole[:3]
        hour, minute = whole[-2:] if kind != "DATE" else (0, 0)
        base = datetime(year, month, day, hour, minute, tzinfo=UTC)
    except ValueError as e:
        raise Malformed(f"no such date or time: {e}") from e
    if seconds >= 60:
        raise Malformed("no such date or time: a minute has 60 seconds")
    since = base - datetime(1970, 1, 1, tzinfo=UTC)
    value = (since.days * 86_400 + since.seconds) * NS_PER_S + int(seconds * NS_PER_S)
    return Constant(value, {"DATE": ty.DATE, "TIME_OF_DAY": ty.TOD}.get(kind, ty.DT))
