"""References to variables: REF() (IEC 61131-3:2013, 6.4.4.10), and in the dialects of CODESYS also ADR and REF=.

A pointer is never a number. It points to a variable, to an element of an array, or to a byte of a string, and at run time it
cannot leave that array or string (`fieldtwin.plc.st.runtime.references`). Numbers may be seen as their bytes or bits. The
compiler refuses what would need more of the memory of a controller, such as the bytes of a structure.
"""

from __future__ import annotations

from typing import NoReturn

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.pointers.sizes import size_of
from fieldtwin.plc.st.compiler.scope import Compiling, Value, by_reference
from fieldtwin.plc.st.compiler.variables import lookup, place, variable
from fieldtwin.plc.st.syntax import tree as t

_BYTE = ty.ELEMENTARY["BYTE"]
_FORMATS = {
    "SINT": "b", "INT": "h", "DINT": "i", "LINT": "q", "USINT": "B", "UINT": "H", "UDINT": "I", "ULINT": "Q",
    "BYTE": "B", "WORD": "H", "DWORD": "I", "LWORD": "Q", "REAL": "f", "LREAL": "d",
}  # fmt: skip
"""The formats of `struct` of the types whose memory can be seen as another type. BOOL, times and texts have other values here
than in the memory of a controller."""
REF_TO, POINTER, REFERENCE = "REF_TO", "POINTER TO", "REFERENCE TO"


def _reference(x: Compiling, expr: t.Expr, what: str) -> Value:
    """Return a reference to the variable `expr`; its type is that of the variable. `what` asks for it, in errors."""
    if not isinstance(expr, t.Ref):
        x.env.fail(expr.pos, f"{what} needs a variable")
    target = variable(x, expr)
    if not target.place or target.constant is not None:
        x.env.fail(expr.pos, f"{what} needs a variable", got="a bit or a constant")
    if target.type == ty.BIT:
        x.env.fail(expr.pos, f"{what} of a BIT, which has no address", expected="a BOOL, or the structure of the BIT")
    element = target.reference.startswith(("_v.Element(", "_v.pointed(", "_v.moved("))
    if by_reference(target.type) and not element:
        return Value(f"_v.Whole({target.code})", target.type, writable=target.writable)
    if not target.reference:
        x.env.fail(expr.pos, f"{what} of {expr.name}, a variable that exists only during a call, is not supported")
    return Value(target.reference, target.type, writable=target.writable)


def ref(x: Compiling, expr: t.Expr) -> Value:
    """Compile ``REF(variable)``. Raises `FileInvalid` for a variable of one call, and for one that cannot be assigned to."""
    found = _reference(x, expr, "REF")
    assert isinstance(expr, t.Ref)
    symbol, _ = lookup(x, expr)
    followed = any(isinstance(selector, t.Deref) for selector in expr.selectors)
    if symbol is not None and not followed and not (symbol.reference or symbol.code).startswith(("self.", "_G.")):
        expected = "a variable of a PROGRAM or FUNCTION_BLOCK that keeps its value, or of VAR_GLOBAL"
        x.env.fail(expr.pos, f"REF of {expr.name}, a variable that exists only during a call", expected=expected)
    if not found.writable:
        x.env.fail(
            expr.pos, f"REF of {expr.name}", expected="a variable that can be assigned to, not an input or a constant"
        )
    return Value(found.code, ty.Pointer(REF_TO, _target(found.type)))


def adr(x: Compiling, expr: t.Expr) -> Value:
    """Compile ``ADR(variable)`` of the dialects of CODESYS."""
    found = _reference(x, expr, "ADR")
    return Value(found.code, ty.Pointer(POINTER, _target(found.type)))


def referring(x: Compiling, expr: t.Expr, target: ty.Pointer, pos: t.Pos) -> str:
    """Return the reference that a REFERENCE TO gets, by ``REF=`` or as an argument, from the variable `expr`, or a call whose
    result is a reference."""
    if isinstance(expr, t.Literal):
        return coerced(x, x.value(expr), target, pos)
    if isinstance(expr, t.Call):
        made = x.value(expr, target)
        if isinstance(made.type, ty.Pointer) and made.type.word == REFERENCE:
            return coerced(x, made, target, pos)
    found = place(x, expr) if isinstance(expr, t.Ref) else None
    if found is not None and found.type == target:
        return found.code
    made = _reference(x, expr, f"a {target}")
    return coerced(x, Value(made.code, ty.Pointer(REFERENCE, _target(made.type))), target, pos)


def coerced(x: Compiling, value: Value, target: ty.Type, pos: t.Pos, what: str = "") -> str:
    """Return the Python expression of `value` as a `target`, where one of them is a reference. Raises `FileInvalid`."""
    source = value.type
    if isinstance(target, ty.Pointer):
        if isinstance(source, ty.Null) or (target.word != REF_TO and source == ty.AnyInt(0)):
            return "None"
        if isinstance(source, ty.Pointer) and source.word == target.word:
            return _converted(x, value.code, source, target, pos)
    hint = ""
    if isinstance(source, ty.Pointer):
        hint = "write ^ for the variable to which it refers"
        if not isinstance(target, ty.Pointer) and source.word == POINTER:
            hint = "an address is not a number here; declare a POINTER TO the type of the variable"
    raise x.env.error(pos, what or "types differ", expected=str(target), got=str(source), hint=hint)


def _converted(x: Compiling, code: str, source: ty.Pointer, target: ty.Pointer, pos: t.Pos) -> str:
    """Return a pointer as one to the same type, to the elements of an array, or to the bytes of a string."""
    held, wanted = source.of, target.of
    if held == wanted or _extends(x, source, target, pos):
        return code
    if (
        target.word != REF_TO
        and isinstance(held, ty.String)
        and isinstance(wanted, ty.String)
        and held.wide == wanted.wide
    ):
        return f"_v.cut({code}, {min(held.length, wanted.length)})"
    if target.word == POINTER:
        if isinstance(held, ty.String) and not held.wide:
            if wanted == _BYTE:
                return f"_v.first(_v.characters({code}, {held.length}))"
            if isinstance(wanted, ty.Array) and _row(wanted) == _BYTE:
                return f"_v.characters({code}, {held.length})"
        if isinstance(held, ty.Array) and _row(held) is not None:
            if _row(held) == wanted:
                return f"_v.first({code})"
            if isinstance(wanted, ty.Array) and _row(held) == _row(wanted):
                return code
        if memory := _memory(code, held, wanted):
            return memory
    raise x.env.error(
        pos, f"the memory of a {held} as a {wanted} is not supported", expected=str(target), got=str(source),
        hint="use a conversion function, or a pointer to the type of the variable",
    )  # fmt: skip


def _memory(code: str, held: ty.Type | ty.Named, wanted: ty.Type | ty.Named) -> str:
    """Return a pointer to numbers or bit strings as one to their memory; "" for other types, whose memory is not known."""
    of, as_type = (_row(kind) if isinstance(kind, ty.Array) else kind for kind in (held, wanted))
    formats = [_FORMATS.get(kind.name, "") if isinstance(kind, ty.Elementary) else "" for kind in (of, as_type)]
    if not all(formats):
        return ""
    found = f"_v.memory({code}, {formats[0]!r}, {formats[1]!r}, array={isinstance(held, ty.Array)})"
    return f"_v.from_beginning({found})" if isinstance(wanted, ty.Array) else found


def _extends(x: Compiling, source: ty.Pointer, target: ty.Pointer, pos: t.Pos) -> bool:
    """Return whether a pointer refers to a block that extends the one to which `target` refers."""
    if not (isinstance(source.of, ty.Named) and isinstance(target.of, ty.Named)):
        return False
    derived, base = x.env.target(source, pos), x.env.target(target, pos)
    return isinstance(derived, ty.Block) and isinstance(base, ty.Block) and base.name.lower() in derived.bases


def _row(array: ty.Array) -> ty.Type | ty.Named | None:
    """Return the type of the elements of an array of one dimension, and None for other arrays."""
    return _target(array.of) if len(array.ranges) == 1 else None


def _target(kind: ty.Type) -> ty.Type | ty.Named:
    """Return a type as the target of a reference."""
    if isinstance(kind, ty.Struct) or (isinstance(kind, ty.Block) and kind.standard is None):
        return ty.Named(kind.name.lower(), kind.name)
    return kind


def queried(x: Compiling, value: Value, kind: ty.Interface, pos: t.Pos) -> str:
    """Return the reference to an instance as an interface that it may implement; it is NULL if the instance does not."""
    if isinstance(value.type, ty.Block) and value.type.standard is None:
        value = Value(f"_v.Instance({value.code})", value.type)
    elif not isinstance(value.type, ty.Interface | ty.Null):
        x.env.fail(
            pos, "the source of an assignment attempt", expected="an interface or an instance", got=str(value.type)
        )
    return f"_v.queried({value.code}, {kind.name.lower()!r})"


# -- operators ----------------------------------------------------------------------------------------------------------


def joined(x: Compiling, expr: t.Binary, left: Value, right: Value) -> Value | None:
    """Compile an operator of which an operand is a reference; return None for other operands.

    References can be compared with ``=`` and ``<>``, and a POINTER TO can be moved by a number of bytes.
    """
    kinds = {type(v.type) for v in (left, right)}
    if ty.Pointer not in kinds and kinds != {ty.Null}:
        return None
    if expr.op in ("=", "<>"):
        return _compared(x, expr, left, right)
    kind = left.type
    if not (isinstance(kind, ty.Pointer) and kind.word == POINTER and expr.op in ("+", "-")) or not ty.is_kind(
        right.type, "int", "bits"
    ):
        _refuse(x, expr, left, right)
    size = size_of(x.env, x.env.target(kind, expr.pos), expr.pos)
    return Value(f"_v.moved({left.code}, {'-' if expr.op == '-' else ''}({right.code}), {size})", kind)


def _compared(x: Compiling, expr: t.Binary, left: Value, right: Value) -> Value:
    kinds = [v.type for v in (left, right) if isinstance(v.type, ty.Pointer)]
    if len({kind.word for kind in kinds}) > 1:
        _refuse(x, expr, left, right)
    kind = kinds[0] if kinds else ty.Pointer(REF_TO, ty.BOOL)  # NULL = NULL
    a, b = (v.code if isinstance(v.type, ty.Pointer) else coerced(x, v, kind, expr.pos) for v in (left, right))
    same = f"_v.same({a}, {b})"
    return Value(same if expr.op == "=" else f"(not {same})", ty.BOOL)


def _refuse(x: Compiling, expr: t.Binary, left: Value, right: Value) -> NoReturn:
    x.env.fail(
        expr.pos, f"operands of {expr.op}", expected="two references with = or <>, or a POINTER TO and a number of bytes",
        got=f"{left.type} and {right.type}",
    )  # fmt: skip
