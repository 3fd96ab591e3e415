"""Standard functions of strings (IEC 61131-3, table 34): positions count from 1."""

from __future__ import annotations

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.arguments import Formals
from fieldtwin.plc.st.compiler.functions.library import ONE, TWO, Library, number, string
from fieldtwin.plc.st.compiler.scope import Compiling, Value
from fieldtwin.plc.st.syntax import tree as t

STRINGS = Library()


@STRINGS.add("LEN", takes=ONE)
def _len(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    s, kind = string(x, given[0])
    return Value(f"len({s})", ty.INT if kind.length <= ty.INT.high else ty.DINT)


@STRINGS.add("LEFT", "RIGHT", takes=Formals(("IN", "L")))
def _side(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    what, length = given
    (s, kind), n = string(x, what), number(x, length, "int").code
    if call.ref.name.upper() == "LEFT":
        return Value(f"{s}[:max(0, {n})]", kind)
    return Value(f"_v.right({s}, {n})", kind)


@STRINGS.add("MID", "DELETE", takes=Formals(("IN", "L", "P")))
def _cut(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    what, length, position = given
    s, kind = string(x, what)
    name = "mid" if call.ref.name.upper() == "MID" else "deleted"
    return Value(f"_v.{name}({s}, {number(x, length, 'int').code}, {number(x, position, 'int').code})", kind)


@STRINGS.add("CONCAT", takes=Formals(repeats="IN", least=1))
def _concat(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    parts = [string(x, e) for e in given]
    if len({kind.wide for _, kind in parts}) > 1:
        x.env.fail(call.pos, "CONCAT of STRING and WSTRING")
    total = sum(kind.length for _, kind in parts)
    code = f"({' + '.join(s for s, _ in parts)})" + (f"[:{ty.MAX_STRING}]" if total > ty.MAX_STRING else "")
    return Value(code, ty.String(min(ty.MAX_STRING, total), parts[0][1].wide))


@STRINGS.add("FIND", takes=TWO)
def _find(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    (s, kind), (o, _) = (string(x, e) for e in given)
    return Value(f"_v.find({s}, {o})", ty.INT if kind.length <= ty.INT.high else ty.DINT)


@STRINGS.add("INSERT", takes=Formals(("IN1", "IN2", "P")))
@STRINGS.add("REPLACE", takes=Formals(("IN1", "IN2", "L", "P")))
def _within(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    what, other, *numbers = given
    (s, kind), (o, other_kind) = string(x, what), string(x, other)
    longest = ty.String(min(ty.MAX_STRING, kind.length + other_kind.length), kind.wide)
    rest = ", ".join(number(x, n, "int").code for n in numbers)
    return Value(f"_v.{'inserted' if call.ref.name.upper() == 'INSERT' else 'replaced'}({s}, {o}, {rest})", longest)


@STRINGS.add("CHR", takes=ONE)
def _chr(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    return Value(f"chr({number(x, given[0], 'int', 'bits').code} & 255)", ty.String(1))


@STRINGS.add("ASC", takes=Formals(("IN", "P"), optional=1))
def _asc(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    what, *position = given
    at = number(x, position[0], "int").code if position else "1"
    return Value(f"_v.code_of({string(x, what)[0]}, {at})", ty.ELEMENTARY["BYTE"])
