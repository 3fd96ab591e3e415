"""The standard functions (IEC 61131-3, 6.6.2.5) by name: each checks its arguments' types and says what Python to write.

Beyond the standard: IS_GOOD(input), FIRST_SCAN(), SCAN_TIME(), and for messages MSG_COUNT, MSG_AT, MSG_TIME, MSG_ROOM,
MSG_SEND (a message is a STRING with one character a byte).
"""

from __future__ import annotations

from collections.abc import Callable

from plc.st import tree as t
from plc.st import types as ty
from plc.st import values
from plc.st.conversions import conversion
from plc.st.scope import Compiling, Value, wrapped

Function = Callable[[Compiling, t.Call], Value]
MANY = 1000
_MATH = {
    "SQRT": "sqrt", "LN": "log", "LOG": "log10", "EXP": "exp", "SIN": "sin", "COS": "cos", "TAN": "tan", "ASIN": "asin",
    "ACOS": "acos", "ATAN": "atan",
}  # fmt: skip


class _Library:
    def __init__(self) -> None:
        self._by_name: dict[str, Function] = {}

    def add(self, *names: str) -> Callable[[Function], Function]:
        def keep(function: Function) -> Function:
            for name in names:
                self._by_name[name] = function
            return function

        return keep

    def find(self, name: str) -> Function | None:
        return self._by_name.get(name) or conversion(name)

    def names(self) -> list[str]:
        return list(self._by_name)


FUNCTIONS = _Library()


def _number(x: Compiling, expr: t.Expr, *kinds: str) -> Value:
    value = x.value(expr)
    if not ty.is_kind(value.type, *kinds):
        x.env.fail(expr.pos, "an argument", expected=" or ".join(kinds), got=str(value.type))
    return value


def _meeting(x: Compiling, exprs: list[t.Expr]) -> tuple[list[str], ty.Type]:
    """All arguments in the type in which they meet."""
    found = [x.value(e) for e in exprs]
    kind = found[0].type
    for value, expr in zip(found[1:], exprs[1:], strict=True):
        meeting = ty.common(kind, value.type)
        if meeting is None:
            x.env.fail(expr.pos, "arguments of types that do not meet", got=f"{kind} and {value.type}")
        kind = meeting
    if isinstance(kind, ty.AnyInt):  # the narrowest type that holds them all
        kind = next(k for k in (ty.INT, ty.DINT, ty.LINT, ty.ULINT) if all(ty.fits(v.type, k) for v in found))
    elif isinstance(kind, ty.AnyReal):
        return [repr(float(v.constant)) if v.constant is not None else v.code for v in found], kind
    if isinstance(kind, ty.String):
        kind = ty.String(max(v.type.length for v in found if isinstance(v.type, ty.String)), kind.wide)
    return [x.coerced(v, kind, e.pos) for v, e in zip(found, exprs, strict=True)], kind


@FUNCTIONS.add(*_MATH)
def _of_real(x: Compiling, call: t.Call) -> Value:
    expr = x.positional(call, 1)[0]
    value = _number(x, expr, "real", "int")
    name = _MATH[call.ref.name.upper()]
    if isinstance(value.type, ty.AnyInt | ty.AnyReal) and value.constant is not None:
        try:
            known = values.of_real(name, value.constant)
        except values.LogicError as e:
            x.env.fail(expr.pos, e.message, got=e.got)
        return x.known(call, known)
    kind = value.type if isinstance(value.type, ty.Elementary) and value.type.kind == "real" else ty.LREAL
    code = f"_v.of_real({name!r}, {value.code})"
    return Value(f"_v.real({code})" if kind.bits == 32 else code, kind)


@FUNCTIONS.add("ATAN2")
def _atan2(x: Compiling, call: t.Call) -> Value:
    a, b = (_number(x, e, "real", "int") for e in x.positional(call, 2))
    if {a.type, b.type} == {ty.REAL}:
        return Value(f"_v.real(_v.math.atan2({a.code}, {b.code}))", ty.REAL)
    return Value(f"_v.math.atan2({a.code}, {b.code})", ty.LREAL)


@FUNCTIONS.add("EXPT")
def _expt(x: Compiling, call: t.Call) -> Value:
    a, b = x.positional(call, 2)
    return x.value(t.Binary(call.pos, "**", a, b))


_OPERATORS = {
    "ADD": "+", "MUL": "*", "SUB": "-", "DIV": "/", "GT": ">", "GE": ">=", "EQ": "=", "LE": "<=", "LT": "<", "NE": "<>",
}  # fmt: skip


@FUNCTIONS.add(*_OPERATORS)
def _operator(x: Compiling, call: t.Call) -> Value:
    """Operators by their function's name (Tables 29 and 33): ADD and MUL of two or more, comparisons of two."""
    name = call.ref.name.upper()
    first, *rest = x.positional(call, 2, MANY if name in ("ADD", "MUL") else None)
    made: t.Expr = first
    for operand in rest:
        made = t.Binary(call.pos, _OPERATORS[name], made, operand)
    return x.value(made)


@FUNCTIONS.add("ABS")
def _abs(x: Compiling, call: t.Call) -> Value:
    value = _number(x, x.positional(call, 1)[0], "int", "real", "duration")
    kind = ty.plain(value.type)
    if isinstance(kind, ty.Elementary):
        return Value(wrapped(f"abs({value.code})", kind), kind)
    known = abs(value.constant)
    return Value(repr(known), ty.AnyInt(known) if isinstance(known, int) else ty.AnyReal(known), known)


@FUNCTIONS.add("MIN", "MAX")
def _extreme(x: Compiling, call: t.Call) -> Value:
    codes, kind = _meeting(x, x.positional(call, 2, MANY))
    return Value(f"{call.ref.name.lower()}({', '.join(codes)})", kind)


@FUNCTIONS.add("LIMIT")
def _limit(x: Compiling, call: t.Call) -> Value:
    (low, value, high), kind = _meeting(x, x.positional(call, 3))
    return Value(f"min(max({value}, {low}), {high})", kind)


@FUNCTIONS.add("SEL")
def _sel(x: Compiling, call: t.Call) -> Value:
    selector, *choices = x.positional(call, 3)
    condition = x.condition(selector, "SEL")
    (no, yes), kind = _meeting(x, choices)
    return Value(f"({yes} if {condition} else {no})", kind)


@FUNCTIONS.add("MUX")
def _mux(x: Compiling, call: t.Call) -> Value:
    selector, *choices = x.positional(call, 2, MANY)
    number = _number(x, selector, "int")
    codes, kind = _meeting(x, choices)
    return Value(f"_v.pick({number.code}, {', '.join(codes)})", kind)


@FUNCTIONS.add("MOVE")
def _move(x: Compiling, call: t.Call) -> Value:
    return x.value(x.positional(call, 1)[0])


@FUNCTIONS.add("SHL", "SHR", "ROL", "ROR")
def _shift(x: Compiling, call: t.Call) -> Value:
    what, by = x.positional(call, 2)
    value, count = _number(x, what, "bits"), _number(x, by, "int")
    kind = ty.plain(value.type)
    assert isinstance(kind, ty.Elementary)
    name = call.ref.name.upper()
    n = count.code if name.endswith("L") else f"-{count.code}"
    return Value(f"_v.{'shift' if name.startswith('SH') else 'rotate'}({value.code}, {n}, {kind.bits})", kind)


# -- strings ------------------------------------------------------------------------------------------------------------


def _string(x: Compiling, expr: t.Expr) -> tuple[str, ty.String]:
    value = x.value(expr)
    if not isinstance(value.type, ty.String):
        x.env.fail(expr.pos, "an argument", expected="a string", got=str(value.type))
    return value.code, value.type


@FUNCTIONS.add("LEN")
def _len(x: Compiling, call: t.Call) -> Value:
    s, kind = _string(x, x.positional(call, 1)[0])
    return Value(f"len({s})", ty.INT if kind.length <= ty.INT.high else ty.DINT)


@FUNCTIONS.add("LEFT", "RIGHT")
def _side(x: Compiling, call: t.Call) -> Value:
    what, length = x.positional(call, 2)
    (s, kind), n = _string(x, what), _number(x, length, "int").code
    if call.ref.name.upper() == "LEFT":
        return Value(f"{s}[:max(0, {n})]", kind)
    return Value(f"_v.right({s}, {n})", kind)


@FUNCTIONS.add("MID", "DELETE")
def _cut(x: Compiling, call: t.Call) -> Value:
    what, length, position = x.positional(call, 3)
    s, kind = _string(x, what)
    name = "mid" if call.ref.name.upper() == "MID" else "deleted"
    return Value(f"_v.{name}({s}, {_number(x, length, 'int').code}, {_number(x, position, 'int').code})", kind)


@FUNCTIONS.add("CONCAT")
def _concat(x: Compiling, call: t.Call) -> Value:
    parts = [_string(x, e) for e in x.positional(call, 1, MANY)]
    if len({kind.wide for _, kind in parts}) > 1:
        x.env.fail(call.pos, "CONCAT of STRING and WSTRING")
    total = sum(kind.length for _, kind in parts)
    code = f"({' + '.join(s for s, _ in parts)})" + (f"[:{ty.MAX_STRING}]" if total > ty.MAX_STRING else "")
    return Value(code, ty.String(min(ty.MAX_STRING, total), parts[0][1].wide))


@FUNCTIONS.add("INSERT", "REPLACE", "FIND")
def _within(x: Compiling, call: t.Call) -> Value:
    name = call.ref.name.upper()
    what, other, *numbers = x.positional(call, {"INSERT": 3, "REPLACE": 4, "FIND": 2}[name])
    (s, kind), (o, other_kind) = _string(x, what), _string(x, other)
    if name == "FIND":
        return Value(f"_v.find({s}, {o})", ty.INT if kind.length <= ty.INT.high else ty.DINT)
    longest = ty.String(min(ty.MAX_STRING, kind.length + other_kind.length), kind.wide)
    rest = ", ".join(_number(x, n, "int").code for n in numbers)
    return Value(f"_v.{'inserted' if name == 'INSERT' else 'replaced'}({s}, {o}, {rest})", longest)


@FUNCTIONS.add("CHR")
def _chr(x: Compiling, call: t.Call) -> Value:
    return Value(f"chr({_number(x, x.positional(call, 1)[0], 'int', 'bits').code} & 255)", ty.String(1))


@FUNCTIONS.add("ASC")
def _asc(x: Compiling, call: t.Call) -> Value:
    what, *position = x.positional(call, 1, 2)
    at = _number(x, position[0], "int").code if position else "1"
    return Value(f"_v.code_of({_string(x, what)[0]}, {at})", ty.ELEMENTARY["BYTE"])


# -- the scan, and what it is given -------------------------------------------------------------------------------------


@FUNCTIONS.add("FIRST_SCAN")
def _first_scan(x: Compiling, call: t.Call) -> Value:
    x.positional(call, 0)
    return Value("_c.first_scan", ty.BOOL)


@FUNCTIONS.add("SCAN_TIME")
def _scan_time(x: Compiling, call: t.Call) -> Value:
    x.positional(call, 0)
    return Value("_c.now_ns", ty.LTIME)


@FUNCTIONS.add("IS_GOOD")
def _is_good(x: Compiling, call: t.Call) -> Value:
    (expr,) = x.positional(call, 1)
    if isinstance(expr, t.Ref) and not expr.selectors:
        symbol = x.symbols.get(expr.name.lower())
        if symbol is not None and symbol.code.startswith("self.v_") and symbol.name in x.program_inputs:
            return Value(f"_c.is_good({symbol.name!r})", ty.BOOL)
    raise x.env.error(expr.pos, "IS_GOOD asks for the quality of an input", expected="a VAR_INPUT of this program")


def _messages(x: Compiling, expr: t.Expr, kind: type) -> str:
    value = x.value(expr)
    if not isinstance(value.type, kind):
        way = "VAR_INPUT" if kind is ty.MessagesIn else "VAR_OUTPUT"
        x.env.fail(expr.pos, "messages", expected=f"a {way} of type MESSAGES", got=str(value.type))
    return value.code


@FUNCTIONS.add("MSG_COUNT")
def _msg_count(x: Compiling, call: t.Call) -> Value:
    return Value(f"len({_messages(x, x.positional(call, 1)[0], ty.MessagesIn)})", ty.DINT)


@FUNCTIONS.add("MSG_AT", "MSG_TIME")
def _msg_at(x: Compiling, call: t.Call) -> Value:
    what, at = x.positional(call, 2)
    code = f"_c.message({_messages(x, what, ty.MessagesIn)}, {_number(x, at, 'int').code})"
    if call.ref.name.upper() == "MSG_TIME":
        return Value(f"{code}.t_ns", ty.LTIME)
    return Value(f"{code}.data.decode('latin-1')", ty.String(ty.MAX_STRING))


@FUNCTIONS.add("MSG_ROOM", "MSG_MAX")
def _msg_room(x: Compiling, call: t.Call) -> Value:
    box = _messages(x, x.positional(call, 1)[0], ty.MessagesOut)
    return Value(f"{box}.{'room' if call.ref.name.upper() == 'MSG_ROOM' else 'max_bytes'}", ty.DINT)


@FUNCTIONS.add("MSG_SEND")
def _msg_send(x: Compiling, call: t.Call) -> Value:
    what, text, *when = x.positional(call, 2, 3)
    box, (s, kind) = _messages(x, what, ty.MessagesOut), _string(x, text)
    if kind.wide:
        x.env.fail(text.pos, "a message", expected="a STRING: a character a byte", got=str(kind))
    t_ns = _number(x, when[0], "duration").code if when else "_c.now_ns"
    return Value(f"{box}.send({s}.encode('latin-1'), {t_ns})", ty.BOOL)
