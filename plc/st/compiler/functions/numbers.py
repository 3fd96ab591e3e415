"""Standard functions of numbers, comparisons, choices and bit strings (IEC 61131-3, tables 28 to 33)."""

from __future__ import annotations

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st import values
from fieldtwin.plc.st.compiler.arguments import Formals
from fieldtwin.plc.st.compiler.functions.library import ONE, TWO, Library, number
from fieldtwin.plc.st.compiler.implicit import meeting
from fieldtwin.plc.st.compiler.scope import COMPARISONS, Compiling, Value, wrapped
from fieldtwin.plc.st.syntax import tree as t

NUMBERS = Library()
_SOME = Formals(repeats="IN", least=2)
_MATH = {
    "SQRT": "sqrt", "LN": "log", "LOG": "log10", "EXP": "exp", "SIN": "sin", "COS": "cos", "TAN": "tan", "ASIN": "asin",
    "ACOS": "acos", "ATAN": "atan",
}  # fmt: skip


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


@NUMBERS.add(*_MATH, takes=ONE)
def _of_real(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    (expr,) = given
    value = number(x, expr, "real", "int")
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


@NUMBERS.add("ATAN2", takes=Formals(("Y", "X")))
def _atan2(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    a, b = (number(x, e, "real", "int") for e in given)
    if {a.type, b.type} == {ty.REAL}:
        return Value(f"_v.real(_v.math.atan2({a.code}, {b.code}))", ty.REAL)
    return Value(f"_v.math.atan2({a.code}, {b.code})", ty.LREAL)


_BINARY = {"SUB": "-", "DIV": "/", "MOD": "MOD", "EXPT": "**", "NE": "<>"}
_CHAINS = {"ADD": "+", "MUL": "*", "AND": "AND", "OR": "OR", "XOR": "XOR"}
_SEQUENCES = {"GT": ">", "GE": ">=", "EQ": "=", "LE": "<=", "LT": "<"}


@NUMBERS.add(*_BINARY, takes=TWO)
@NUMBERS.add(*_CHAINS, takes=_SOME)
def _operator(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    """Write an operator that is called by its function's name (Tables 29, 30 and 33)."""
    name = call.ref.name.upper()
    op = _BINARY.get(name) or _CHAINS[name]
    made, *rest = given
    for operand in rest:
        made = t.Binary(call.pos, op, made, operand)
    return x.value(made, x.wanted)


@NUMBERS.add("NOT", takes=ONE)
def _not(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    return x.value(t.Unary(call.pos, "NOT", given[0]), x.wanted)


@NUMBERS.add(*_SEQUENCES, takes=_SOME)
def _sequence(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    """Write a comparison of each argument with the next one (Table 33). For example, GT is true for a decreasing sequence."""
    op = _SEQUENCES[call.ref.name.upper()]
    if len(given) == 2:
        return x.value(t.Binary(call.pos, op, *given))
    codes, kind = _meeting(x, given)
    if not isinstance(kind, ty.Elementary | ty.AnyReal | ty.String | ty.Enum):
        x.env.fail(call.pos, f"arguments of {call.ref.name}", expected="values that can be compared", got=str(kind))
    return Value(f"({f' {COMPARISONS[op]} '.join(codes)})", ty.BOOL)


@NUMBERS.add("ABS", takes=ONE)
def _abs(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    value = number(x, given[0], "int", "real", "duration")
    kind = ty.plain(value.type)
    if isinstance(kind, ty.Elementary):
        return Value(wrapped(f"abs({value.code})", kind), kind)
    known = abs(value.constant)
    return Value(repr(known), ty.AnyInt(known) if isinstance(known, int) else ty.AnyReal(known), known)


@NUMBERS.add("MIN", "MAX", takes=_SOME)
def _extreme(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    codes, kind = _meeting(x, given)
    return Value(f"{call.ref.name.lower()}({', '.join(codes)})", kind)


@NUMBERS.add("LIMIT", takes=Formals(("MN", "IN", "MX")))
def _limit(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    (low, value, high), kind = _meeting(x, given)
    return Value(f"min(max({value}, {low}), {high})", kind)


@NUMBERS.add("SEL", takes=Formals(("G", "IN0", "IN1")))
def _sel(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    selector, *choices = given
    condition = x.condition(selector, "SEL")
    (no, yes), kind = _meeting(x, choices)
    return Value(f"({yes} if {condition} else {no})", kind)


@NUMBERS.add("MUX", takes=Formals(("K",), repeats="IN", first=0, least=1))
def _mux(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    selector, *choices = given
    place = number(x, selector, "int")
    codes, kind = _meeting(x, choices)
    selected = place.code
    if x.env.dialect.vendor:  # a selector beyond the inputs selects the last one
        selected = f"min({selected}, {len(codes) - 1})"
    return Value(f"_v.pick({selected}, {', '.join(codes)})", kind)


@NUMBERS.add("MOVE", takes=ONE)
def _move(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    return x.value(given[0], x.wanted)


_WIDTHS = tuple(ty.ELEMENTARY[name] for name in ("BYTE", "WORD", "DWORD", "LWORD", "SINT", "INT", "DINT", "LINT"))


def _type_of_shifted(x: Compiling, kind: ty.AnyInt, wanted: ty.Type | None) -> ty.Elementary | None:
    """Return the type of a constant without a type that is shifted: the one which the context demands, else, in the dialects
    of CODESYS, the narrowest one that holds the constant. None if it is unknown.
    """
    if ty.takes_bits(wanted, kind) and wanted.kind != "bool":
        return wanted
    integer = isinstance(wanted, ty.Elementary) and wanted.kind == "int" and ty.fits(kind, wanted)
    if isinstance(wanted, ty.Elementary) and integer and "ST004" in x.env.dialect.accepts:
        return wanted
    return _narrowest(kind) if x.env.dialect.vendor else None


def _narrowest(kind: ty.AnyInt) -> ty.Elementary:
    return next(one for one in _WIDTHS if ty.fits(kind, one))


def _most(name: str, kind: ty.AnyInt, count: Value) -> int | None:
    """Return the largest number that a shift of a constant gives if no bit is lost; None if the width changes its result."""
    if name == "SHR":
        return kind.value
    if name == "SHL" and isinstance(count.constant, int) and 0 <= count.constant < 64:
        return kind.value << count.constant
    return None


def _warn_of_width(x: Compiling, pos: t.Pos, what: str, kind: ty.AnyInt, made: ty.Elementary, most: int | None) -> None:
    """Warn of a constant that CODESYS may shift with fewer bits: its manuals name the narrowest type, for any target."""
    narrow = _narrowest(kind)
    if most is None or not narrow.low <= most <= narrow.high:
        other = f" here, and may have {narrow.bits} on a controller" if narrow.bits < made.bits else ""
        x.env.accepts("ST010", pos, f"{what} has {made.bits} bits{other}")


_SHIFTS = {"SHL": "shift_left", "SHR": "shift_right", "ROL": "rotate_left", "ROR": "rotate_right"}


@NUMBERS.add(*_SHIFTS, takes=Formals(("IN", "N")))
def _shift(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    what, by = given
    wanted = ty.plain(x.wanted) if x.wanted is not None else None
    value, count = x.value(what, wanted), number(x, by, "int")
    kind, name = ty.plain(value.type), call.ref.name.upper()
    if isinstance(kind, ty.AnyInt):
        made = _type_of_shifted(x, kind, wanted)
        if made is None:
            x.env.fail(
                what.pos, "the width of this literal is unknown here", expected="a bit string", got=str(kind),
                hint="write its type before it, such as WORD#16#0001",
            )  # fmt: skip
        if x.env.dialect.vendor:
            _warn_of_width(x, what.pos, f"{name} of the constant {kind.value}", kind, made, _most(name, kind, count))
        value, kind = Value(x.coerced(value, made, what.pos), made), made
    if not isinstance(kind, ty.Elementary) or not (
        kind.kind == "bits" or (kind.kind == "int" and x.env.accepts("ST004", what.pos, f"{name} of {kind}"))
    ):
        x.env.fail(what.pos, "an argument", expected="bits", got=str(value.type))
    if kind.low < 0 and name == "SHR":
        return Value(f"_v.arithmetic_right({value.code}, {count.code})", kind)
    operand = f"{value.code} & {kind.high - kind.low}" if kind.low < 0 else value.code
    code = f"_v.{_SHIFTS[name]}({operand}, {count.code}, {kind.bits})"
    return Value(f"_v.signed({code}, {kind.bits})" if kind.low < 0 else code, kind)
