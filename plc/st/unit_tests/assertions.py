"""Tests and assertions that were translated into programs, for the two forms of tests (`translate` and `tcunit`)."""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.errors import invalid

COMPARISONS = {
    "ASSERT_EQ": "=", "ASSERT_NE": "<>", "ASSERT_LT": "<", "ASSERT_LE": "<=", "ASSERT_GT": ">", "ASSERT_GE": ">=",
}  # fmt: skip

ARRAYS = "ASSERT_ARRAYS"
"""The kind of an assertion that compares two arrays."""


@dataclass(frozen=True, slots=True)
class AssertionText:
    """The text of an assertion in a report: its place and its text as in the source, the words before the expected value, and
    the MESSAGE of the user.
    """

    pos: t.Pos
    text: str
    expected: str
    message: str


@dataclass(frozen=True, slots=True)
class TranslatedTest:
    """A test as the PROGRAM `program` of a unit, with its assertions by their number.

    A `cyclic` test is a part of a program that is executed until all its tests have ended. `number` identifies it.
    """

    pos: t.Pos
    name: str
    program: str
    assertions: dict[int, AssertionText]
    number: int = 0
    cyclic: bool = False


def bound(call: t.Call, parameters: tuple[str, ...]) -> dict[str, t.Expr]:
    """Return the arguments of a call by parameter in capitals. The last one, MESSAGE, is optional.

    Raises `FileInvalid` for an unknown, repeated or missing argument.
    """
    of, expected = call.ref.name, ", ".join(parameters)
    found: dict[str, t.Expr] = {}
    for n, argument in enumerate(call.arguments):
        key = argument.name.upper() or (parameters[n] if n < len(parameters) else "")
        if key not in parameters or key in found or argument.value is None:
            got = argument.name or f"{len(call.arguments)} arguments"
            raise invalid(argument.pos, f"the arguments of {of}", expected, got)
        found[key] = argument.value
    if missing := [name for name in parameters if name not in (*found, "MESSAGE")]:
        raise invalid(call.pos, f"{of} lacks {', '.join(missing)}", expected)
    return found


def assertion(kind: str, pos: t.Pos, number: int, given: list[t.Expr], of_test: int = 0) -> list[t.Statement]:
    """Return the statements of an assertion: its arguments, each evaluated once, and the check of the condition `kind`."""
    held = [t.Hold(value.pos, f"0value_{number}_{n}", value) for n, value in enumerate(given)]
    shown: list[t.Expr] = [t.Ref(hold.pos, hold.name) for hold in held]
    return [*held, t.Assertion(pos, number, _condition(kind, pos, shown), tuple(shown), of_test)]


def _condition(name: str, pos: t.Pos, values: list[t.Expr]) -> t.Expr | None:
    """Return the condition that an assertion checks; None if it is about arrays. `values` are its arguments, but no message."""
    if name == ARRAYS:
        return None
    if name == "ASSERT_TRUE":
        return values[0]
    if name == "ASSERT_FALSE":
        return t.Unary(pos, "NOT", values[0])
    if name in COMPARISONS:
        return t.Binary(pos, COMPARISONS[name], values[0], values[1])
    difference = t.Argument(pos, "", t.Binary(pos, "-", values[0], values[1]))
    return t.Binary(pos, "<=", t.Call(pos, t.Ref(pos, "ABS"), (difference,)), values[2])
