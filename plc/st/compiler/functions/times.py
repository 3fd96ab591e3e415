"""Standard functions of times and dates by name: arithmetic (IEC 61131-3, table 35), CONCAT and SPLIT (table 36)."""

from __future__ import annotations

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.arguments import Formals
from fieldtwin.plc.st.compiler.functions.library import ONE, TWO, Library, number
from fieldtwin.plc.st.compiler.scope import Compiling, Value, wrapped
from fieldtwin.plc.st.syntax import tree as t

TIMES = Library()
_DAY = ("YEAR", "MONTH", "DAY")
_CLOCK = ("HOUR", "MINUTE", "SECOND", "MILLISECOND")

_ARITHMETIC = {
    "ADD_TIME": ("+", "duration", "duration"), "ADD_TOD_TIME": ("+", "tod", "duration"), "ADD_DT_TIME": ("+", "dt", "duration"),
    "SUB_TIME": ("-", "duration", "duration"), "SUB_DATE_DATE": ("-", "date", "date"), "SUB_TOD_TIME": ("-", "tod", "duration"),
    "SUB_TOD_TOD": ("-", "tod", "tod"), "SUB_DT_TIME": ("-", "dt", "duration"), "SUB_DT_DT": ("-", "dt", "dt"),
    "MUL_TIME": ("*", "duration", "int real"), "DIV_TIME": ("/", "duration", "int real"),
    # the names of the second edition
    "MULTIME": ("*", "duration", "int real"), "DIVTIME": ("/", "duration", "int real"),
}  # fmt: skip
_LONG = {
    "ADD_LTIME": "ADD_TIME", "ADD_LTOD_LTIME": "ADD_TOD_TIME", "ADD_LDT_LTIME": "ADD_DT_TIME", "SUB_LTIME": "SUB_TIME",
    "SUB_LDATE_LDATE": "SUB_DATE_DATE", "SUB_LTOD_LTIME": "SUB_TOD_TIME", "SUB_LTOD_LTOD": "SUB_TOD_TOD",
    "SUB_LDT_LTIME": "SUB_DT_TIME", "SUB_LDT_LDT": "SUB_DT_DT", "MUL_LTIME": "MUL_TIME", "DIV_LTIME": "DIV_TIME",
}  # fmt: skip
"""The functions of LTIME and its dates, and those of TIME that compute the same, because both have 64 bits here."""


@TIMES.add(*_ARITHMETIC, *_LONG, takes=TWO)
def _of_times(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    """Write arithmetic of times and dates by its function's name (Table 35)."""
    name = call.ref.name.upper()
    op, *kinds = _ARITHMETIC[_LONG.get(name, name)]
    for expr, kind in zip(given, kinds, strict=True):
        number(x, expr, *kind.split())
    made = x.value(t.Binary(call.pos, op, *given))
    return Value(made.code, ty.LTIME) if name in _LONG and ty.is_kind(made.type, "duration") else made


@TIMES.add("CONCAT_DATE_TOD", "CONCAT_DATE_LTOD", takes=TWO)
def _date_and_time(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    date, time = number(x, given[0], "date"), number(x, given[1], "tod")
    return Value(wrapped(f"{date.code} + {time.code}", ty.DT), ty.DT)


@TIMES.add("CONCAT_DATE", takes=Formals(_DAY))
@TIMES.add("CONCAT_TOD", "CONCAT_LTOD", takes=Formals(_CLOCK))
@TIMES.add("CONCAT_DT", "CONCAT_LDT", takes=Formals((*_DAY, *_CLOCK)))
def _concat(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    kind = {"DATE": ty.DATE, "TOD": ty.TOD, "LTOD": ty.TOD}.get(call.ref.name.upper()[7:], ty.DT)
    name = {ty.DATE: "date_of", ty.TOD: "tod_of", ty.DT: "dt_of"}[kind]
    return Value(f"_v.{name}({', '.join(number(x, e, 'int').code for e in given)})", kind)


@TIMES.add("SPLIT_DATE", takes=ONE, gives=_DAY)
@TIMES.add("SPLIT_TOD", "SPLIT_LTOD", takes=ONE, gives=_CLOCK)
@TIMES.add("SPLIT_DT", "SPLIT_LDT", takes=ONE, gives=(*_DAY, *_CLOCK))
def _split(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    """Write a tuple: the outputs of the function."""
    kind = {"DATE": "date", "TOD": "tod", "LTOD": "tod"}.get(call.ref.name.upper()[6:], "dt")
    return Value(f"_v.split_{kind}({number(x, given[0], kind).code})", ty.NOTHING)


@TIMES.add("DAY_OF_WEEK", takes=ONE)
def _day_of_week(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    wanted = ty.plain(x.wanted) if x.wanted is not None else None
    kind = wanted if isinstance(wanted, ty.Elementary) and wanted.kind == "int" else ty.INT
    return Value(f"_v.day_of_week({number(x, given[0], 'date').code})", kind)
