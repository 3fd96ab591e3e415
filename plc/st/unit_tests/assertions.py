"""Tests and assertions that were translated into programs, for the two forms of tests (`translate` and `tcunit`)."""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.syntax import tree as t

COMPARISONS = {
    "ASSERT_EQ": "=", "ASSERT_NE": "<>", "ASSERT_LT": "<", "ASSERT_LE": "<=", "ASSERT_GT": ">", "ASSERT_GE": ">=",
}  # fmt: skip


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


def invalid(pos: t.Pos, message: str, expected: str = "", got: str = "", hint: str = "") -> FileInvalid:
    """Return an error at a place of the source."""
    return FileInvalid(message, path=pos.path, line=pos.line, column=pos.column, expected=expected, got=got, hint=hint)


def condition(name: str, pos: t.Pos, values: list[t.Expr]) -> t.Expr:
    """Return the condition that an assertion checks. `values` are its arguments without the message."""
    if name == "ASSERT_TRUE":
        return values[0]
    if name == "ASSERT_FALSE":
        return t.Unary(pos, "NOT", values[0])
    if name in COMPARISONS:
        return t.Binary(pos, COMPARISONS[name], values[0], values[1])
    difference = t.Argument(pos, "", t.Binary(pos, "-", values[0], values[1]))
    return t.Binary(pos, "<=", t.Call(pos, t.Ref(pos, "ABS"), (difference,)), values[2])
