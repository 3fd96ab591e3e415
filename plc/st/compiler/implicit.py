"""Implicit conversions that only a vendor's dialect allows: between integers, bit strings, reals and enumerations.

Each one is a warning, so that a user finds the places where a value can change. A number that is not a value of an enumeration
stops the task, because no branch of the program was written for it. In the other dialects nothing is converted here.
"""

from __future__ import annotations

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.scope import Compiling, Value
from fieldtwin.plc.st.syntax.tree import Pos

_SIGNED = tuple(ty.ELEMENTARY[name] for name in ("SINT", "INT", "DINT", "LINT"))
_UNSIGNED = {8: "USINT", 16: "UINT", 32: "UDINT", 64: "ULINT"}
_EXACT = {32: 24, 64: 53}
"""The largest width in bits of integers of which a REAL or an LREAL holds each one."""


def converted(x: Compiling, value: Value, target: ty.Type, pos: Pos) -> str | None:
    """Return the Python code of `value` as a `target`, or None if the dialect does not allow the conversion."""
    source, sink = ty.plain(value.type), ty.plain(target)
    if isinstance(sink, ty.Interface):
        return "None" if x.env.dialect.vendor and _is_null(source) else None
    if isinstance(sink, ty.Enum):
        return _to_enum(x, value, source, sink, pos)
    if isinstance(source, ty.Enum):
        source = _number_type(source)
        if not x.env.accepts("ST006", pos, f"{value.type} is used as a number"):
            return None
        value = Value(value.code, source)
    if not (isinstance(source, ty.Elementary) and isinstance(sink, ty.Elementary)):
        return None
    if not ty.fits(source, sink):
        warning = _warning(source, sink)
        if not warning or not x.env.accepts(warning, pos, f"{value.type} is converted to {sink}"):
            return None
    code = _code(value.code, source, sink)
    return f"_v.inside({code}, {target.low}, {target.high})" if isinstance(target, ty.Subrange) else code


def _is_null(kind: ty.Type) -> bool:
    """Return whether a value of this type is the constant 0, which CODESYS also accepts for NULL."""
    return isinstance(kind, ty.AnyInt) and kind.value == 0


def _to_enum(x: Compiling, value: Value, source: ty.Type, enum: ty.Enum, pos: Pos) -> str | None:
    if not (isinstance(source, ty.AnyInt | ty.Enum) or ty.is_kind(source, "int", "bits")):
        return None
    if value.constant is not None and value.constant not in enum.values.values():
        return None
    if not x.env.accepts("ST006", pos, f"a number is used as a value of {enum}"):
        return None
    return f"_v.enumerated({value.code}, {tuple(sorted(set(enum.values.values())))!r}, {enum.name!r})"


def _warning(source: ty.Elementary, sink: ty.Elementary) -> str:
    """Return the id of the warning about a conversion; "" for one that no dialect allows."""
    whole = ("int", "bits")
    if source.kind in whole and sink.kind in whole:
        return "ST003" if sink.low <= source.low and source.high <= sink.high else "ST002"
    if source.kind in whole and sink.kind == "real":
        return "ST002" if source.bits > _EXACT[sink.bits] else "ST003"
    return "ST002" if source.kind == sink.kind == "real" else ""


def _code(code: str, source: ty.Elementary, sink: ty.Elementary) -> str:
    if sink.kind == "real":
        return f"_v.real({code})" if ty.is_rounded(source, sink) else f"float({code})"
    if sink.low <= source.low and source.high <= sink.high:
        return code
    return f"_v.signed({code}, {sink.bits})" if sink.low < 0 else f"({code} & {sink.high})"


def as_number(x: Compiling, value: Value, pos: Pos, common: ty.Type | None = None) -> Value:
    """Return a bit string as an unsigned integer and an enumeration as an integer, if the dialect allows it; else `value`.

    `common`: the common type of both operands, to which a literal is converted first if the other operand is a bit string.
    """
    kind = ty.plain(value.type)
    if not x.env.dialect.vendor:
        return value
    if isinstance(kind, ty.Enum) and x.env.accepts("ST006", pos, f"{kind} is used as a number"):
        return Value(value.code, _number_type(kind), value.constant)
    if isinstance(kind, ty.AnyInt) and isinstance(common, ty.Elementary) and common.kind == "bits":
        return Value(value.code, _unsigned(common), value.constant)
    if not (isinstance(kind, ty.Elementary) and kind.kind == "bits"):
        return value
    if x.env.accepts("ST003", pos, f"{kind} is used as a number"):
        return Value(value.code, _unsigned(kind), value.constant)
    return value


def meeting(x: Compiling, left: ty.Type, right: ty.Type, pos: Pos) -> ty.Type | None:
    """Return the type in which two operands meet: that of the standard, else the one to which the dialect converts both."""
    found = ty.common(left, right)
    if found is not None or not x.env.dialect.vendor:
        return found
    for one, other in ((left, right), (right, left)):
        if isinstance(one, ty.Interface) and _is_null(other):
            return one
    a, b = _numeric(left), _numeric(right)
    if a is None or b is None:
        return None
    found = ty.common(a, b)
    if found is not None:
        return found
    reals = [kind for kind in (a, b) if kind.kind == "real"]
    if reals:
        return max(reals, key=lambda kind: kind.bits)
    for kind in _SIGNED:
        if all(kind.low <= one.low and one.high <= kind.high for one in (a, b)):
            break
    x.env.accepts("ST008", pos, f"operands of {a} and {b} are computed as {kind}")
    return kind


def logical_type(x: Compiling, left: ty.Type, right: ty.Type, pos: Pos) -> ty.Type | None:
    """Return the type in which a vendor's dialect computes AND, OR and XOR of two operands, one of which is an integer."""
    a, b = _numeric(left, bits=True), _numeric(right, bits=True)
    if a is None or b is None or "real" in (a.kind, b.kind):
        return None
    if not x.env.accepts("ST005", pos, f"a logical operation on {left} and {right}"):
        return None
    strings = [kind for kind in (a, b) if kind.kind == "bits"]
    if strings:
        return max(a, b, key=lambda kind: kind.bits) if len(strings) == 2 else _bits(max(a.bits, b.bits))
    return meeting(x, a, b, pos)


def _numeric(kind: ty.Type, bits: bool = False) -> ty.Elementary | None:
    """Return the numeric type that represents values of `kind`, or None. `bits` keeps bit strings."""
    kind = ty.plain(kind)
    if isinstance(kind, ty.Enum):
        return _number_type(kind)
    if isinstance(kind, ty.AnyInt):
        return next((one for one in (*_SIGNED, ty.ULINT) if one.low <= kind.value <= one.high), None)
    if isinstance(kind, ty.AnyReal):
        return ty.REAL
    if isinstance(kind, ty.Elementary) and kind.kind in ("int", "real", "bits"):
        return _unsigned(kind) if kind.kind == "bits" and not bits else kind
    return None


def _number_type(enum: ty.Enum) -> ty.Elementary:
    numbers = enum.values.values()
    return next((one for one in _SIGNED[1:] if one.low <= min(numbers) and max(numbers) <= one.high), ty.ULINT)


def _unsigned(kind: ty.Elementary) -> ty.Elementary:
    return ty.ELEMENTARY[_UNSIGNED[kind.bits]]


def _bits(bits: int) -> ty.Elementary:
    return ty.ELEMENTARY[{8: "BYTE", 16: "WORD", 32: "DWORD", 64: "LWORD"}[bits]]
