"""Functions of references: REF (IEC 61131-3:2013, 6.4.4.10), and ADR, SIZEOF and __ISVALIDREF of the dialects of CODESYS."""

from __future__ import annotations

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.arguments import Formals
from fieldtwin.plc.st.compiler.functions.library import ONE, Library
from fieldtwin.plc.st.compiler.pointers.references import REFERENCE, adr, queried, ref
from fieldtwin.plc.st.compiler.pointers.sizes import size_of
from fieldtwin.plc.st.compiler.scope import Compiling, Value
from fieldtwin.plc.st.compiler.variables import lookup, place
from fieldtwin.plc.st.syntax import tree as t

REFERENCES = Library()


@REFERENCES.add("REF", takes=ONE)
def _ref(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    return ref(x, given[0])


@REFERENCES.add("ADR", takes=ONE)
def _adr(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    only_in_dialects(x, call, "the standard has REF")
    return adr(x, given[0])


@REFERENCES.add("SIZEOF", "XSIZEOF", takes=ONE)
def _sizeof(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    """Write the size of a variable or of a type, which is known to the compiler."""
    only_in_dialects(x, call, "")
    (expr,) = given
    if not isinstance(expr, t.Ref):
        x.env.fail(expr.pos, f"the argument of {call.ref.name}", expected="a variable or a type")
    kind = x.type_of(expr)
    if kind is None and not expr.selectors and lookup(x, expr)[0] is None:
        kind = ty.ELEMENTARY.get(expr.name.upper()) or x.env.types.get(expr.name.lower())
    if kind is None:
        x.env.unknown(expr.pos, "a variable or a type", expr.name, [s.name for s in x.symbols.values()])
    size = size_of(x.env, kind, expr.pos)
    return Value(repr(size), ty.AnyInt(size), size)


@REFERENCES.add("__ISVALIDREF", takes=ONE)
def _is_valid(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    only_in_dialects(x, call, "")
    (expr,) = given
    found = place(x, expr) if isinstance(expr, t.Ref) else None
    if found is None or not (isinstance(found.type, ty.Pointer) and found.type.word == REFERENCE):
        x.env.fail(expr.pos, f"the argument of {call.ref.name}", expected="a REFERENCE TO")
    return Value(f"({found.code} is not None)", ty.BOOL)


@REFERENCES.add("__QUERYINTERFACE", takes=Formals(("IN", "OUT")))
def _query_interface(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    """Write the assignment of an instance to a variable of an interface; the result is whether the instance implements it."""
    only_in_dialects(x, call, "the standard has ?=")
    source, target = given
    kind = x.type_of(target) if isinstance(target, t.Ref) else None
    if not (isinstance(target, t.Ref) and isinstance(kind, ty.Interface)):
        x.env.fail(target.pos, f"the second argument of {call.ref.name}", expected="a variable of an interface type")
    found = x.out.temporary()
    x.out.line(f"{found} = {queried(x, x.value(source), kind, source.pos)}", call.pos)
    x.take(t.Argument(target.pos, "", None, target), Value(found, kind))
    return Value(f"({found} is not None)", ty.BOOL)


def only_in_dialects(x: Compiling, call: t.Call, instead: str) -> None:
    """Raise `FileInvalid` for a call in a dialect without this function. `instead` is what the standard has, if anything."""
    if not x.env.dialect.vendor:
        hint = "; ".join(each for each in (instead, "the dialects codesys and twincat accept it") if each)
        x.env.fail(call.pos, f"{call.ref.name.upper()} is not in the standard", hint=hint)
