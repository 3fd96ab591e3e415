"""Functions that are not in the standard: the scan, the quality of inputs, and mailboxes of messages.

These are IS_GOOD(input), FIRST_SCAN(), SCAN_TIME(), and for messages MSG_COUNT, MSG_AT, MSG_TIME, MSG_ROOM, MSG_SEND (a
message is a STRING with one character per byte).
"""

from __future__ import annotations

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.arguments import Formals
from fieldtwin.plc.st.compiler.functions.library import ONE, Library, number, string
from fieldtwin.plc.st.compiler.scope import Compiling, Value
from fieldtwin.plc.st.syntax import tree as t

SCAN = Library()
_BOX = Formals(("BOX",))


@SCAN.add("FIRST_SCAN", takes=Formals())
def _first_scan(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    return Value("_c.first_scan", ty.BOOL)


@SCAN.add("SCAN_TIME", takes=Formals())
def _scan_time(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    return Value("_c.scan_ns", ty.LTIME)


@SCAN.add("IS_GOOD", takes=ONE)
def _is_good(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    (expr,) = given
    if isinstance(expr, t.Ref) and not expr.selectors:
        symbol = x.symbols.get(expr.name.lower()) or x.env.globals.get(expr.name.lower())
        if symbol is not None and symbol.is_input and symbol.name in x.program_inputs:
            return Value(f"_c.is_good({symbol.name!r})", ty.BOOL)
    raise x.env.error(expr.pos, "IS_GOOD asks for the quality of an input", expected="a VAR_INPUT of this program")


def _messages(x: Compiling, expr: t.Expr, kind: type) -> str:
    value = x.value(expr)
    if not isinstance(value.type, kind):
        way = "VAR_INPUT" if kind is ty.MessagesIn else "VAR_OUTPUT"
        x.env.fail(expr.pos, "messages", expected=f"a {way} of type MESSAGES", got=str(value.type))
    return value.code


@SCAN.add("MSG_COUNT", takes=_BOX)
def _msg_count(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    return Value(f"len({_messages(x, given[0], ty.MessagesIn)})", ty.DINT)


@SCAN.add("MSG_AT", "MSG_TIME", takes=Formals(("BOX", "I")))
def _msg_at(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    what, at = given
    code = f"_c.message({_messages(x, what, ty.MessagesIn)}, {number(x, at, 'int').code})"
    if call.ref.name.upper() == "MSG_TIME":
        return Value(f"{code}.t_ns", ty.LTIME)
    return Value(f"{code}.data.decode('latin-1')", ty.String(ty.MAX_STRING))


@SCAN.add("MSG_ROOM", "MSG_MAX", takes=_BOX)
def _msg_room(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    box = _messages(x, given[0], ty.MessagesOut)
    return Value(f"{box}.{'room' if call.ref.name.upper() == 'MSG_ROOM' else 'max_bytes'}", ty.DINT)


@SCAN.add("MSG_SEND", takes=Formals(("BOX", "TEXT", "T"), optional=1))
def _msg_send(x: Compiling, call: t.Call, given: list[t.Expr]) -> Value:
    what, text, *when = given
    box, (s, kind) = _messages(x, what, ty.MessagesOut), string(x, text)
    if kind.wide:
        x.env.fail(text.pos, "a message", expected="a STRING: a character a byte", got=str(kind))
    t_ns = number(x, when[0], "duration").code if when else "_c.now_ns"
    return Value(f"{box}.send({s}.encode('latin-1'), {t_ns})", ty.BOOL)
