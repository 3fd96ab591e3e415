"""A group of standard functions by name, and what several groups need to read their arguments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.arguments import Formals, in_order
from fieldtwin.plc.st.compiler.implicit import as_number
from fieldtwin.plc.st.compiler.scope import Compiling, Value
from fieldtwin.plc.st.syntax import tree as t

Write = Callable[[Compiling, t.Call, list[t.Expr]], Value]
"""A function that writes the Python code of a call. The list holds the arguments in the order of the parameters."""
ONE = Formals(("IN",))
TWO = Formals(("IN1", "IN2"))


@dataclass(frozen=True, slots=True)
class Standard:
    """A standard function: the names of its parameters, and the function that writes a call.

    A function with `outputs` has no result; its code is a tuple with a whole number for each output.
    """

    formals: Formals
    write: Write
    outputs: tuple[str, ...] = ()

    def __call__(self, x: Compiling, call: t.Call) -> Value:
        if not self.outputs:
            return self.write(x, call, in_order(x.env, call, self.formals))
        inputs = replace(call, arguments=tuple(a for a in call.arguments if a.target is None))
        made = x.out.temporary()
        x.out.line(f"{made} = {self.write(x, call, in_order(x.env, inputs, self.formals)).code}", call.pos)
        for argument in call.arguments:
            if argument.target is not None:
                self._take(x, argument, made, call.ref.name)
        return Value("None", ty.NOTHING)

    def _take(self, x: Compiling, argument: t.Argument, made: str, of: str) -> None:
        """Write the assignment of an output. Its type is ANY_INT, so its value is checked against the target at run time."""
        assert argument.target is not None
        if argument.name.upper() not in self.outputs:
            x.env.unknown(argument.pos, f"in {of}, an output", argument.name, list(self.outputs))
        kind = ty.plain(x.type_of(argument.target) or ty.INT)
        if not (isinstance(kind, ty.Elementary) and kind.kind == "int"):
            x.env.fail(argument.pos, f"{argument.name} of {of}", expected="an integer", got=str(kind))
        place = self.outputs.index(argument.name.upper())
        x.take(argument, Value(f"_v.to_integer({made}[{place}], {kind.low}, {kind.high})", kind))


class Library:
    """Standard functions by their names in capitals. `parts` are libraries whose functions it also has."""

    def __init__(self, *parts: Library) -> None:
        self.by_name: dict[str, Standard] = {name: found for part in parts for name, found in part.by_name.items()}

    def add(self, *names: str, takes: Formals, gives: tuple[str, ...] = ()) -> Callable[[Write], Write]:
        """Declare the functions `names`. `takes`: their parameters, with the names of the standard; `gives`: their outputs."""

        def keep(write: Write) -> Write:
            for name in names:
                self.by_name[name] = Standard(takes, write, gives)
            return write

        return keep

    def names(self) -> list[str]:
        return list(self.by_name)


def number(x: Compiling, expr: t.Expr, *kinds: str) -> Value:
    """Compile an argument whose type is of one of `kinds` (`fieldtwin.plc.st.types.Elementary`). Raises `FileInvalid`."""
    value = x.value(expr)
    if "int" in kinds and not ty.is_kind(value.type, *kinds):
        value = as_number(x, value, expr.pos)
    if not ty.is_kind(value.type, *kinds):
        x.env.fail(expr.pos, "an argument", expected=" or ".join(kinds), got=str(value.type))
    return value


def string(x: Compiling, expr: t.Expr) -> tuple[str, ty.String]:
    """Compile an argument that is a string. Raises `FileInvalid`."""
    value = x.value(expr)
    if ty.is_kind(value.type, "char"):
        return value.code, ty.String(1, value.type == ty.WCHAR)
    if not isinstance(value.type, ty.String):
        x.env.fail(expr.pos, "an argument", expected="a string", got=str(value.type))
    return value.code, value.type
