"""The standard functions (IEC 61131-3, 6.6.2.5) by name. Each checks the types of its arguments and returns Python code.

Functions that are not in the standard: IS_GOOD(input), FIRST_SCAN(), SCAN_TIME(), and for messages MSG_COUNT, MSG_AT, MSG_TIME,
MSG_ROOM, MSG_SEND (a message is a STRING with one character per byte).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st import values
from fieldtwin.plc.st.compiler.arguments import Formals, in_order
from fieldtwin.plc.st.compiler.conversions import Write, conversion
from fieldtwin.plc.st.compiler.implicit import as_number, meeting
from fieldtwin.plc.st.compiler.scope import COMPARISONS, Compiling, Value, wrapped
from fieldtwin.plc.st.syntax import tree as t

_TWO = Formals(("IN1", "IN2"))
_SOME = Formals(repeats="IN", least=2)
_ONE = Formals(("IN",))
_BOX = Formals(("BOX",))
_MATH = {
    "SQRT": "sqrt", "LN": "log", "LOG": "log10", "EXP": "exp", "SIN": "sin", "COS": "cos", "TAN": "tan", "ASIN": "asin",
    "ACOS": "acos", "ATAN": "atan",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Standard:
    """A standard function: the names of its parameters, and the function that writes a call."""

    formals: Formals
    write: Write

    def __call__(self, x: Compiling, call: t.Call) -> Value:
        return self.write(x, call, in_order(x.env, call, self.formals))


class _Library:
    def __init__(self) -> None:
        self._by_name: dict[str, Standard] = {}

    def add(self, *names: str, takes: Formals) -> Callable[[Write], Write]:
        """Declare the functions `names`. `takes`: their parameters, with the names of the standard."""

        def keep(write: Write) -> Write:
            for name in names:
                self._by_name[name] = Standard(takes, write)
            return write

        return keep

    def find(self, name: str) -> Standard | None:
        """Return the function called `name` (in capitals), including conversions, or None."""
        found = self._by_name.get(name)
        if found is None and (write := conversion(name)) is not None:
            found = Standard(_ONE, write)
        return found

    def names(self) -> list[str]:
        return list(self._by_name)


FUNCTIONS = _Library()


def _number(x: Compiling, expr: t.Expr, *kinds: str) -> Value:
    value = x.value(expr)
    if "int" in kinds and not ty.is_kind(value.type, *kinds):
        value = as_number(x, value, expr.pos)
    if not ty.is_kind(value.type, *kinds):
        x.env.fail(expr.pos, "an argument", expected=" or ".join(kinds), got=str(value.type))
    return value


def _meeting(x: Compiling, exprs: list[t.Expr]) -> tuple[list[str], ty.Type]:
    """Return the Python code of all arguments, converted to their common type, and that type."""
    wanted = ty.plain(x.wanted) if x.wanted is not None else None
    found = [x.value(e, wanted or x.declared(*exprs)) for e in exprs]
    kind = found[0].type
    for value, expr in zip(found[1:], exprs[1:], strict=True):
        both = meeting(x, kind, value.type, expr.pos)
        if both is None:
            x.env.fail(expr.pos, "arguments of incompatible types", got=f"{kind} and {value.type}")
        kind = both
    if (
        isinstance(kind, ty.AnyInt)
        and isinstance(wanted, ty.Elementary)
        and all(ty.fits(v.type, wanted) for v in found)
    ):
        kind = wanted
    elif isinstance(kind, ty.AnyInt):  # the narrowest type that holds all of them
        kind = next(k for k in (ty.INT, ty.DINT, ty.LINT, ty.ULINT) if all(ty.fits(v.type, k) for v in found))
    elif isinstance(kind, ty.AnyReal):
        return [repr(float(v.constant)) if v.constant is not None else v.code for v in found], kind
    if isinstance(kind, ty.String):
        kind = ty.String(max(v.type.length for v in found if isinstance(v.type, ty.String)), kind.wide)
    return [x.coerced(v, kind, e.pos) for v, e in zip(found, exprs, strict=True)], kind


@FUNCTIONS.add(*_MATH, takes=_ONE)
def _of_real(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    (expr,) = given
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


@FUNCTIONS.add("ATAN2", takes=Formals(("Y", "X")))
def _atan2(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    a, b = (_number(x, e, "real", "int") for e in given)
    if {a.type, b.type} == {ty.REAL}:
        return Value(f"_v.real(_v.math.atan2({a.code}, {b.code}))", ty.REAL)
    return Value(f"_v.math.atan2({a.code}, {b.code})", ty.LREAL)


_BINARY = {"SUB": "-", "DIV": "/", "MOD": "MOD", "EXPT": "**", "NE": "<>"}
_CHAINS = {"ADD": "+", "MUL": "*", "AND": "AND", "OR": "OR", "XOR": "XOR"}
_SEQUENCES = {"GT": ">", "GE": ">=", "EQ": "=", "LE": "<=", "LT": "<"}


@FUNCTIONS.add(*_BINARY, takes=_TWO)
@FUNCTIONS.add(*_CHAINS, takes=_SOME)
def _operator(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    """Write an operator that is called by its function's name (Tables 29, 30 and 33)."""
    name = call.ref.name.upper()
    op = _BINARY.get(name) or _CHAINS[name]
    made, *rest = given
    for operand in rest:
        made = t.Binary(call.pos, op, made, operand)
    return x.value(made, x.wanted)


@FUNCTIONS.add(*_SEQUENCES, takes=_SOME)
def _sequence(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    """Write a comparison of each argument with the next one (Table 33). For example, GT is true for a decreasing sequence."""
    op = _SEQUENCES[call.ref.name.upper()]
    if len(given) == 2:
        return x.value(t.Binary(call.pos, op, *given))
    codes, kind = _meeting(x, given)
    if not isinstance(kind, ty.Elementary | ty.AnyReal | ty.String | ty.Enum):
        x.env.fail(call.pos, f"arguments of {call.ref.name}", expected="values that can be compared", got=str(kind))
    return Value(f"({f' {COMPARISONS[op]} '.join(codes)})", ty.BOOL)


_TIMES = {
    "ADD_TIME": ("+", "duration", "duration"), "ADD_TOD_TIME": ("+", "tod", "duration"), "ADD_DT_TIME": ("+", "dt", "duration"),
    "SUB_TIME": ("-", "duration", "duration"), "SUB_DATE_DATE": ("-", "date", "date"), "SUB_TOD_TIME": ("-", "tod", "duration"),
    "SUB_TOD_TOD": ("-", "tod", "tod"), "SUB_DT_TIME": ("-", "dt", "duration"), "SUB_DT_DT": ("-", "dt", "dt"),
    "MUL_TIME": ("*", "duration", "int real"), "DIV_TIME": ("/", "duration", "int real"),
}  # fmt: skip


@FUNCTIONS.add(*_TIMES, takes=_TWO)
def _of_times(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    """Write arithmetic of times and dates by its function's name (Table 35)."""
    op, *kinds = _TIMES[call.ref.name.upper()]
    for expr, kind in zip(given, kinds, strict=True):
        _number(x, expr, *kind.split())
    return x.value(t.Binary(call.pos, op, *given))


@FUNCTIONS.add("CONCAT_DATE_TOD", takes=_TWO)
def _date_and_time(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    date, time = _number(x, given[0], "date"), _number(x, given[1], "tod")
    return Value(wrapped(f"{date.code} + {time.code}", ty.DT), ty.DT)


@FUNCTIONS.add("ABS", takes=_ONE)
def _abs(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    value = _number(x, given[0], "int", "real", "duration")
    kind = ty.plain(value.type)
    if isinstance(kind, ty.Elementary):
        return Value(wrapped(f"abs({value.code})", kind), kind)
    known = abs(value.constant)
    return Value(repr(known), ty.AnyInt(known) if isinstance(known, int) else ty.AnyReal(known), known)


@FUNCTIONS.add("MIN", "MAX", takes=_SOME)
def _extreme(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    codes, kind = _meeting(x, given)
    return Value(f"{call.ref.name.lower()}({', '.join(codes)})", kind)


@FUNCTIONS.add("LIMIT", takes=Formals(("MN", "IN", "MX")))
def _limit(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    (low, value, high), kind = _meeting(x, given)
    return Value(f"min(max({value}, {low}), {high})", kind)


@FUNCTIONS.add("SEL", takes=Formals(("G", "IN0", "IN1")))
def _sel(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    selector, *choices = given
    condition = x.condition(selector, "SEL")
    (no, yes), kind = _meeting(x, choices)
    return Value(f"({yes} if {condition} else {no})", kind)


@FUNCTIONS.add("MUX", takes=Formals(("K",), repeats="IN", first=0, least=1))
def _mux(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    selector, *choices = given
    number = _number(x, selector, "int")
    codes, kind = _meeting(x, choices)
    return Value(f"_v.pick({number.code}, {', '.join(codes)})", kind)


@FUNCTIONS.add("MOVE", takes=_ONE)
def _move(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    return x.value(given[0], x.wanted)


_SHIFTS = {"SHL": "shift_left", "SHR": "shift_right", "ROL": "rotate_left", "ROR": "rotate_right"}


@FUNCTIONS.add(*_SHIFTS, takes=Formals(("IN", "N")))
def _shift(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    what, by = given
    wanted = ty.plain(x.wanted) if x.wanted is not None else None
    value, count = x.value(what, wanted), _number(x, by, "int")
    kind = ty.plain(value.type)
    if isinstance(kind, ty.AnyInt):
        if not ty.takes_bits(wanted, kind) or wanted.kind == "bool":
            x.env.fail(
                what.pos, "the width of this literal is unknown here", expected="a bit string", got=str(kind),
                hint="write its type before it, such as WORD#16#0001",
            )  # fmt: skip
        value, kind = Value(x.coerced(value, wanted, what.pos), wanted), wanted
    name = call.ref.name.upper()
    if not isinstance(kind, ty.Elementary) or not (
        kind.kind == "bits" or (kind.kind == "int" and x.env.accepts("ST004", what.pos, f"{name} of {kind}"))
    ):
        x.env.fail(what.pos, "an argument", expected="bits", got=str(value.type))
    if kind.low < 0 and name == "SHR":
        return Value(f"_v.arithmetic_right({value.code}, {count.code})", kind)
    operand = f"{value.code} & {kind.high - kind.low}" if kind.low < 0 else value.code
    code = f"_v.{_SHIFTS[name]}({operand}, {count.code}, {kind.bits})"
    return Value(f"_v.signed({code}, {kind.bits})" if kind.low < 0 else code, kind)


# -- strings ------------------------------------------------------------------------------------------------------------


def _string(x: Compiling, expr: t.Expr) -> tuple[str, ty.String]:
    value = x.value(expr)
    if not isinstance(value.type, ty.String):
        x.env.fail(expr.pos, "an argument", expected="a string", got=str(value.type))
    return value.code, value.type


@FUNCTIONS.add("LEN", takes=_ONE)
def _len(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    s, kind = _string(x, given[0])
    return Value(f"len({s})", ty.INT if kind.length <= ty.INT.high else ty.DINT)


@FUNCTIONS.add("LEFT", "RIGHT", takes=Formals(("IN", "L")))
def _side(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    what, length = given
    (s, kind), n = _string(x, what), _number(x, length, "int").code
    if call.ref.name.upper() == "LEFT":
        return Value(f"{s}[:max(0, {n})]", kind)
    return Value(f"_v.right({s}, {n})", kind)


@FUNCTIONS.add("MID", "DELETE", takes=Formals(("IN", "L", "P")))
def _cut(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    what, length, position = given
    s, kind = _string(x, what)
    name = "mid" if call.ref.name.upper() == "MID" else "deleted"
    return Value(f"_v.{name}({s}, {_number(x, length, 'int').code}, {_number(x, position, 'int').code})", kind)


@FUNCTIONS.add("CONCAT", takes=Formals(repeats="IN", least=1))
def _concat(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    parts = [_string(x, e) for e in given]
    if len({kind.wide for _, kind in parts}) > 1:
        x.env.fail(call.pos, "CONCAT of STRING and WSTRING")
    total = sum(kind.length for _, kind in parts)
    code = f"({' + '.join(s for s, _ in parts)})" + (f"[:{ty.MAX_STRING}]" if total > ty.MAX_STRING else "")
    return Value(code, ty.String(min(ty.MAX_STRING, total), parts[0][1].wide))


@FUNCTIONS.add("FIND", takes=_TWO)
def _find(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    (s, kind), (o, _) = (_string(x, e) for e in given)
    return Value(f"_v.find({s}, {o})", ty.INT if kind.length <= ty.INT.high else ty.DINT)


@FUNCTIONS.add("INSERT", takes=Formals(("IN1", "IN2", "P")))
@FUNCTIONS.add("REPLACE", takes=Formals(("IN1", "IN2", "L", "P")))
def _within(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    what, other, *numbers = given
    (s, kind), (o, other_kind) = _string(x, what), _string(x, other)
    longest = ty.String(min(ty.MAX_STRING, kind.length + other_kind.length), kind.wide)
    rest = ", ".join(_number(x, n, "int").code for n in numbers)
    return Value(f"_v.{'inserted' if call.ref.name.upper() == 'INSERT' else 'replaced'}({s}, {o}, {rest})", longest)


@FUNCTIONS.add("CHR", takes=_ONE)
def _chr(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    return Value(f"chr({_number(x, given[0], 'int', 'bits').code} & 255)", ty.String(1))


@FUNCTIONS.add("ASC", takes=Formals(("IN", "P"), optional=1))
def _asc(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    what, *position = given
    at = _number(x, position[0], "int").code if position else "1"
    return Value(f"_v.code_of({_string(x, what)[0]}, {at})", ty.ELEMENTARY["BYTE"])


# -- the scan and its inputs --------------------------------------------------------------------------------------------


@FUNCTIONS.add("FIRST_SCAN", takes=Formals())
def _first_scan(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    return Value("_c.first_scan", ty.BOOL)


@FUNCTIONS.add("SCAN_TIME", takes=Formals())
def _scan_time(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    return Value("_c.scan_ns", ty.LTIME)


@FUNCTIONS.add("IS_GOOD", takes=_ONE)
def _is_good(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    (expr,) = given
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


@FUNCTIONS.add("MSG_COUNT", takes=_BOX)
def _msg_count(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    return Value(f"len({_messages(x, given[0], ty.MessagesIn)})", ty.DINT)


@FUNCTIONS.add("MSG_AT", "MSG_TIME", takes=Formals(("BOX", "I")))
def _msg_at(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    what, at = given
    code = f"_c.message({_messages(x, what, ty.MessagesIn)}, {_number(x, at, 'int').code})"
    if call.ref.name.upper() == "MSG_TIME":
        return Value(f"{code}.t_ns", ty.LTIME)
    return Value(f"{code}.data.decode('latin-1')", ty.String(ty.MAX_STRING))


@FUNCTIONS.add("MSG_ROOM", "MSG_MAX", takes=_BOX)
def _msg_room(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    box = _messages(x, given[0], ty.MessagesOut)
    return Value(f"{box}.{'room' if call.ref.name.upper() == 'MSG_ROOM' else 'max_bytes'}", ty.DINT)


@FUNCTIONS.add("MSG_SEND", takes=Formals(("BOX", "TEXT", "T"), optional=1))
def _msg_send(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    what, text, *when = given
    box, (s, kind) = _messages(x, what, ty.MessagesOut), _string(x, text)
    if kind.wide:
        x.env.fail(text.pos, "a message", expected="a STRING: a character a byte", got=str(kind))
    t_ns = _number(x, when[0], "duration").code if when else "_c.now_ns"
    return Value(f"{box}.send({s}.encode('latin-1'), {t_ns})", ty.BOOL)
