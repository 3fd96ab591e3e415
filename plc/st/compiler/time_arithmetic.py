"""Arithmetic with durations, dates and times of day (IEC 61131-3, Table 35), as Python text."""

from __future__ import annotations

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.scope import Value, wrapped


def with_time(op: str, left: Value, right: Value) -> Value | None:
    """Return the code of `left` `op` `right` for a duration, date or time of day.

    Return None if neither side has such a type, or if the standard defines no such operation."""
    a, b = ty.plain(left.type), ty.plain(right.type)
    ka, kb = _kind(a), _kind(b)
    x, y = left.code, right.code
    moments = ("dt", "tod", "date")
    result: ty.Type | None = None
    code = f"{x} {op} {y}"
    if op in "+-" and ka == kb == "duration":
        result = ty.common(a, b)
    elif op in "+-" and ka in ("dt", "tod") and kb == "duration":
        result = a
    elif op == "-" and ka == kb and ka in moments:
        result = ty.TIME
    elif op in "*/" and ka == "duration" and kb in ("int", "real"):
        result = a
        if kb == "real":
            code = f"_v.time_{'times' if op == '*' else 'over'}({x}, {y})"
        elif op == "/":
            code = f"_v.divide({x}, {y})"
    elif op == "*" and kb == "duration" and ka in ("int", "real"):
        result = b
        code = f"_v.time_times({y}, {x})" if ka == "real" else code
    if result is None:
        return None
    assert isinstance(result, ty.Elementary)
    if result.kind == "tod":  # a day ends at midnight
        return Value(f"(({code}) % {ty.DAY_NS})", result)
    return Value(wrapped(code, result), result)


def _kind(kind: ty.Type) -> str:
    if isinstance(kind, ty.Elementary):
        return kind.kind
    return "int" if isinstance(kind, ty.AnyInt) else "real" if isinstance(kind, ty.AnyReal) else ""
