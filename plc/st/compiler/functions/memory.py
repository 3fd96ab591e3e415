"""Functions that copy, fill and compare memory: MEMCPY and others of TwinCAT (Tc2_System), SysMemCpy and others of CODESYS."""

from __future__ import annotations

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.arguments import Formals
from fieldtwin.plc.st.compiler.functions.library import Library, Write
from fieldtwin.plc.st.compiler.functions.references import only_in_dialects
from fieldtwin.plc.st.compiler.pointers.memory import layout
from fieldtwin.plc.st.compiler.scope import Compiling, Value
from fieldtwin.plc.st.syntax import tree as t

MEMORY = Library()
_BYTE, _UDINT, _DINT = (ty.ELEMENTARY[name] for name in ("BYTE", "UDINT", "DINT"))
_COPIES = {
    "MEMCPY": ("destAddr", "srcAddr", "n"),
    "MEMMOVE": ("destAddr", "srcAddr", "n"),
    "SYSMEMCPY": ("pDest", "pSrc", "udiCount"),
    "SYSMEMMOVE": ("pDest", "pSrc", "udiCount"),
}
_FILLS = {"MEMSET": ("destAddr", "fillByte", "n"), "SYSMEMSET": ("pDest", "byValue", "udiCount")}
_COMPARISONS = {"MEMCMP": ("pBuf1", "pBuf2", "n"), "SYSMEMCMP": ("pBuffer1", "pBuffer2", "udiCount")}


def _copy(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    names = _COPIES[call.ref.name.upper()]
    places = [_pointer(x, call, expr, name) for expr, name in zip(given[:2], names, strict=False)]
    return _call(x, call, "copied", names[:2], [*places, _number(x, call, given[2], _UDINT, names[2])])


def _fill(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    names = _FILLS[call.ref.name.upper()]
    byte = _number(x, call, given[1], _BYTE, names[1])
    count = _number(x, call, given[2], _UDINT, names[2])
    return _call(x, call, "filled", names[:1], [_pointer(x, call, given[0], names[0]), byte, count])


def _compare(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    names = _COMPARISONS[call.ref.name.upper()]
    places = [_pointer(x, call, expr, name) for expr, name in zip(given[:2], names, strict=False)]
    return _call(x, call, "compared", names[:2], [*places, _number(x, call, given[2], _UDINT, names[2])], _DINT)


def _of_dialects(write: Write) -> Write:
    def written(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
        only_in_dialects(x, call, "")
        return write(x, call, given)

    return written


for _functions, _write in ((_COPIES, _copy), (_FILLS, _fill), (_COMPARISONS, _compare)):
    for _name, _names in _functions.items():
        MEMORY.add(_name, takes=Formals(_names))(_of_dialects(_write))


def _call(
    x: Compiling, call: t.Call, function: str, pointers: tuple[str, ...], arguments: list[str], kind: ty.Type = _UDINT
) -> Value:
    name = call.ref.name.upper()
    return Value(f"_v.copying.{function}({name!r}, {pointers!r}, {', '.join(arguments)})", kind)


def _pointer(x: Compiling, call: t.Call, expr: t.Expr, name: str) -> str:
    """Return the Python expression of a pointer with the layout of the variables to which it points."""
    value, what = x.value(expr), f"{name} of {call.ref.name}"
    kind = value.type
    if not (isinstance(kind, ty.Pointer) and kind.word == "POINTER TO"):
        x.env.fail(expr.pos, what, expected="ADR(variable) or a POINTER TO", got=str(kind))
    return f"({value.code}, {layout(x.env, x.env.target(kind, expr.pos), expr.pos, f'the variable at {what}')})"


def _number(x: Compiling, call: t.Call, expr: t.Expr, kind: ty.Elementary, name: str) -> str:
    """Return an argument that is an integer or a bit string of any width, because its value decides whether it is allowed."""
    value = x.value(expr)
    if not ty.is_kind(value.type, "int", "bits"):
        return x.coerced(value, kind, expr.pos, f"{name} of {call.ref.name}")
    if kind == _BYTE:
        return f"({value.code} & 255)"
    return value.code
