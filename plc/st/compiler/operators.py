"""Operators of expressions: their types (IEC 61131-3, Table 71) as Python code; constants are computed here.

Operands are compiled by the `Compiling` that is passed in.
"""

from __future__ import annotations

from typing import NoReturn, TypeGuard

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st import values
from fieldtwin.plc.st.compiler.implicit import as_number, logical_type, meeting
from fieldtwin.plc.st.compiler.pointers.references import joined
from fieldtwin.plc.st.compiler.scope import COMPARISONS, Compiling, Value, wrapped
from fieldtwin.plc.st.compiler.time_arithmetic import with_time
from fieldtwin.plc.st.syntax import tree as t

_LOGIC = {"AND": "&", "&": "&", "OR": "|", "XOR": "^", "AND_THEN": "and", "OR_ELSE": "or"}


def unary(x: Compiling, expr: t.Unary) -> Value:
    """Compile NOT, or the sign of a number or duration."""
    wanted = x.wanted
    value = x.value(expr.operand, wanted)
    kind = ty.plain(value.type)
    if expr.op == "NOT":
        if isinstance(kind, ty.AnyInt) and ty.takes_bits(wanted, kind):
            value, kind = Value(x.coerced(value, wanted, expr.pos), wanted), wanted
        if ty.is_kind(kind, "bool"):
            return Value(f"(not {value.code})", ty.BOOL, None if value.constant is None else not value.constant)
        if isinstance(kind, ty.Elementary) and kind.kind == "bits":
            return Value(f"({value.code} ^ {kind.high})", kind)
        if _is(kind, "int") and x.env.accepts("ST005", expr.pos, f"NOT of {kind}"):
            return Value(f"(~{value.code})" if kind.low else f"({value.code} ^ {kind.high})", kind)
        x.env.fail(expr.pos, "NOT", expected="BOOL or a bit string", got=str(kind))
    if not ty.is_kind(kind, "int", "real", "duration"):
        x.env.fail(expr.pos, f"the sign {expr.op}", expected="a number or a duration", got=str(kind))
    if expr.op == "+":
        return value
    if isinstance(kind, ty.AnyInt | ty.AnyReal):
        return Value(f"(-{value.code})", kind) if value.constant is None else x.known(expr, -value.constant)
    assert isinstance(kind, ty.Elementary)
    return Value(wrapped(f"-{value.code}", kind), kind)


def _is(kind: ty.Type, name: str) -> TypeGuard[ty.Elementary]:
    return isinstance(kind, ty.Elementary) and kind.kind == name


def binary(x: Compiling, expr: t.Binary) -> Value:
    """Compile a chain of operators from its left end, so that a long chain does not nest deeply."""
    chain, first = [expr], expr.left
    while isinstance(first, t.Binary):
        chain.append(first)
        first = first.left
    wanted = x.wanted if expr.op in _LOGIC else None
    value = x.value(first, wanted or x.declared(*(link.right for link in reversed(chain))))
    for link in reversed(chain):
        value = x.flat(_joined(x, link, value), link.pos)
    return value


def _joined(x: Compiling, expr: t.Binary, left: Value) -> Value:
    mark = len(x.out.lines)
    wanted = left.type if x.of_context(left.type) else x.wanted if expr.op in _LOGIC else None
    right = x.value(expr.right, wanted)
    if expr.op in ("AND_THEN", "OR_ELSE") and len(x.out.lines) > mark:
        left, right = _only_if_needed(x, expr, left, right, x.out.since(mark))
    else:
        left = x.earlier(left, mark, expr.pos)
    of_references = joined(x, expr, left, right)
    if of_references is not None:
        return of_references
    if expr.op in _LOGIC:
        return _logic(x, expr, left, right)
    if expr.op in COMPARISONS:
        return _comparison(x, expr, left, right)
    timed = with_time(expr.op, left, right)
    if timed is not None:
        return timed
    kind = ty.common(left.type, right.type)
    result: ty.Elementary | None = None
    if x.env.dialect.vendor and not (kind is not None and ty.is_kind(kind, "int", "real")):
        result = kind if isinstance(kind, ty.Elementary) and kind.kind == "bits" else None
        left, right = as_number(x, left, expr.pos, kind), as_number(x, right, expr.pos, kind)
        kind = meeting(x, left.type, right.type, expr.pos)
    if kind is None or not ty.is_kind(kind, "int", "real"):
        _mismatch(x, expr, left, right, "numbers of compatible types")
    if isinstance(kind, ty.AnyInt | ty.AnyReal):
        return _folded(x, expr, left, right)
    assert isinstance(kind, ty.Elementary)
    if expr.op == "**":
        kind = kind if kind.kind == "real" else ty.LREAL
        power = f"_v.power({left.code}, {right.code})"
        return Value(f"_v.real({power})" if kind.bits == 32 else power, kind)
    a, b = x.coerced(left, kind, expr.pos), x.coerced(right, kind, expr.pos)
    result = result or kind
    if expr.op == "MOD":
        if kind.kind != "int":
            _mismatch(x, expr, left, right, "integers")
        return Value(f"_v.modulo({a}, {b})", result)
    if expr.op == "/":
        return Value(wrapped(f"_v.{'divide' if kind.kind == 'int' else 'divide_real'}({a}, {b})", kind), result)
    return Value(wrapped(f"{a} {expr.op} {b}", kind), result)


def _only_if_needed(
    x: Compiling, expr: t.Binary, left: Value, right: Value, prepared: list[tuple[str, t.Pos | None]]
) -> tuple[Value, Value]:
    """Return both sides of AND or OR.

    Lines that the right side needs run only if the left side does not decide the result.
    """
    name = x.out.temporary()
    x.out.line(f"{name} = {left.code}", expr.pos)
    decided = "not " if expr.op == "OR_ELSE" else ""
    with x.out.block(f"if {decided}{name}:", expr.pos):
        x.out.again(prepared)
        x.out.line(f"{name} = {right.code}", expr.pos)
    known = Value(name, left.type)
    return known, Value(name, right.type)


def _logic(x: Compiling, expr: t.Binary, left: Value, right: Value) -> Value:
    a, b = left.constant, right.constant
    untyped = isinstance(left.type, ty.AnyInt) and isinstance(right.type, ty.AnyInt)
    if untyped and expr.op in ("AND", "&", "OR", "XOR") and min(a, b) >= 0:  # the context determines the width
        return x.known(expr, a & b if expr.op in ("AND", "&") else a | b if expr.op == "OR" else a ^ b)
    kind = ty.common(left.type, right.type)
    if kind is None or not ty.is_kind(kind, "bool", "bits"):
        kind = logical_type(x, left.type, right.type, expr.pos)
    if kind is None:
        _mismatch(x, expr, left, right, "BOOL, or bit strings (BYTE, WORD, DWORD, LWORD) of compatible types")
    a_code, b_code = x.coerced(left, kind, expr.pos), x.coerced(right, kind, expr.pos)
    if expr.op in ("AND_THEN", "OR_ELSE") and not ty.is_kind(kind, "bool"):
        _mismatch(x, expr, left, right, "BOOL")
    return Value(f"({a_code} {_LOGIC[expr.op]} {b_code})", kind)


def _comparison(x: Compiling, expr: t.Binary, left: Value, right: Value) -> Value:
    kind = meeting(x, left.type, right.type, expr.pos)
    if isinstance(kind, ty.Interface) and expr.op in ("=", "<>"):
        code = f"_v.same({x.coerced(left, kind, expr.pos)}, {x.coerced(right, kind, expr.pos)})"
        return Value(code if expr.op == "=" else f"(not {code})", ty.BOOL)
    if kind is None or not isinstance(kind, ty.Elementary | ty.AnyInt | ty.AnyReal | ty.String | ty.Enum):
        _mismatch(x, expr, left, right, "two values of compatible types")
    if isinstance(kind, ty.AnyInt | ty.AnyReal | ty.String):
        a, b = left.code, right.code
    else:
        a, b = x.coerced(left, kind, expr.pos), x.coerced(right, kind, expr.pos)
    return Value(f"({a} {COMPARISONS[expr.op]} {b})", ty.BOOL)


def _folded(x: Compiling, expr: t.Binary, left: Value, right: Value) -> Value:
    a, b = left.constant, right.constant
    if a is None or b is None:  # a choice between constants (SEL, MAX)
        if expr.op == "MOD":
            _mismatch(x, expr, left, right, "integers")
        return Value(_of_reals(expr.op, left.code, right.code), ty.AnyReal(0.0))
    whole = isinstance(a, int) and isinstance(b, int)
    try:
        if expr.op == "/":
            result = values.divide(a, b) if whole else values.divide_real(a, b)
        elif expr.op == "MOD" and whole:
            result = values.modulo(a, b)
        elif expr.op == "**":
            result = values.power(a, b)
        elif expr.op in ("+", "-", "*"):
            result = a + b if expr.op == "+" else a - b if expr.op == "-" else a * b
        else:
            _mismatch(x, expr, left, right, "integers")
    except values.LogicError as e:
        x.env.fail(expr.pos, e.message)
    return x.known(expr, result)


def _mismatch(x: Compiling, expr: t.Binary, left: Value, right: Value, expected: str) -> NoReturn:
    x.env.fail(expr.pos, f"operands of {expr.op}", expected=expected, got=f"{left.type} and {right.type}")


def _of_reals(op: str, a: str, b: str) -> str:
    if op in ("/", "**"):
        return f"_v.{'divide_real' if op == '/' else 'power'}({a}, {b})"
    return f"({a} {op} {b})"
