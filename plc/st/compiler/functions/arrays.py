"""LOWER_BOUND and UPPER_BOUND of arrays (IEC 61131-3:2013, table 15): the limits of a dimension, which counts from 1."""

from __future__ import annotations

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.arguments import Formals
from fieldtwin.plc.st.compiler.functions.library import Library, number
from fieldtwin.plc.st.compiler.scope import Compiling, Value
from fieldtwin.plc.st.compiler.variables import variable
from fieldtwin.plc.st.syntax import tree as t

ARRAYS = Library()


@ARRAYS.add("LOWER_BOUND", "UPPER_BOUND", takes=Formals(("ARR", "DIM")))
def _bound(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    array, dimension = given
    kind = x.type_of(array) if isinstance(array, t.Ref) else None
    if not isinstance(array, t.Ref) or not isinstance(kind, ty.Array | ty.OpenArray):
        x.env.fail(
            array.pos, f"the argument ARR of {call.ref.name}", expected="an array", got=str(kind or "an expression")
        )
    end = 0 if call.ref.name.upper() == "LOWER_BOUND" else 1
    at = number(x, dimension, "int")
    count = len(kind.ranges) if isinstance(kind, ty.Array) else kind.dimensions
    if at.constant is not None and not 1 <= at.constant <= count:
        x.env.fail(
            dimension.pos, "a dimension that the array does not have", expected=f"1 to {count}", got=str(at.constant)
        )
    if isinstance(kind, ty.OpenArray):
        return Value(f"_v.bound({variable(x, array).code}.ranges, {at.code}, {end})", ty.DINT)
    if at.constant is None:
        return Value(f"_v.bound({kind.ranges}, {at.code}, {end})", ty.DINT)
    known = kind.ranges[at.constant - 1][end]
    return Value(repr(known), ty.AnyInt(known), known)
