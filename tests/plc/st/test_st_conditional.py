"""Conditional compilation of CODESYS and TwinCAT."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from st_bench import run

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.dialects import DIALECTS
from fieldtwin.plc.st.syntax.source import blanked


def number(body: str, before: str = "") -> int:
    found: int = run("n : INT;", body, before, dialect="codesys")["n"]
    return found


@pytest.mark.parametrize(
    ("condition", "expected"),
    [
        ("defined (FAST)", 1),
        ("defined(fast)", 1),
        ("defined (SLOW)", 2),
        ("NOT defined (SLOW)", 1),
        ("defined (FAST) AND defined (SLOW)", 2),
        ("defined (FAST) OR defined (SLOW)", 1),
        ("NOT (defined (SLOW) OR defined (FAST))", 2),
        ("defined (SLOW) AND defined (SLOW) OR defined (FAST)", 1),
    ],
)
def test_a_condition_selects_the_text_that_is_compiled(condition: str, expected: int) -> None:
    assert number(f"{{IF {condition}}} n := 1; {{ELSE}} n := 2; {{END_IF}}", "{define FAST 'yes'}") == expected


def test_only_the_first_branch_with_a_true_condition_is_compiled() -> None:
    body = "{IF defined (A)} n := 'a'; {ELSIF defined (B)} n := 2; {ELSIF defined (C)} n := 'c'; {ELSE} n := it's;\n{END_IF}"
    assert number(body, "{define B} {define C}") == 2


def test_conditions_may_be_nested_and_hide_declarations_and_directives() -> None:
    body = "{IF defined (A)} {define B} {IF defined (B)} n := x; {END_IF} {ELSE} n := n + 4; {END_IF}"
    assert number(body + "{IF defined (B)} n := y; {END_IF}") == 4


def test_a_name_is_defined_until_it_is_undefined() -> None:
    body = "{define A}{IF defined (A)} n := n + 1; {END_IF} {undefine A}{IF defined (A)} n := n + 10; {END_IF}"
    assert number(body) == 1


def test_an_error_after_a_hidden_part_has_its_line_and_column() -> None:
    with pytest.raises(FileInvalid, match="'m' is not declared") as error:
        number("{IF defined (A)}\nn := x;\n{END_IF} m := 1;")
    assert (error.value.line, error.value.column) == (5, 10)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("{IF defined (A)} n := 1;", "an {IF} that does not end"),
        ("{ELSE} n := 1; {END_IF}", "{ELSE} without {IF}"),
        ("{END_IF}", "{END_IF} without {IF}"),
        ("{IF defined (A)} {ELSE} {ELSE} {END_IF}", "{ELSE} after {ELSE}"),
        ("{IF defined (A)} {ELSE} {ELSIF defined (B)} {END_IF}", "{ELSIF} after {ELSE}"),
        ("{IF} n := 1; {END_IF}", "a condition of {IF} that is not complete"),
        ("{IF defined (A} n := 1; {END_IF}", "not complete"),
        ("{IF defined (A) defined (B)} {END_IF}", "defined in the condition of {IF}"),
        ("{IF A} {END_IF}", "A in the condition of {IF}"),
        ("{IF hastype (x, INT)} {END_IF}", "the condition hastype .* is not supported"),
        ("{IF defined (type: T1)} {END_IF}", "the condition defined \\(type: ...\\) is not supported"),
        ("{define}", "{DEFINE} without a name"),
        ("{IF defined (A)}" * 33, "nested too deep"),
    ],
)
def test_wrong_directives_are_refused(body: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message.replace("{", "\\{").replace("}", "\\}")):
        number(body)


@pytest.mark.parametrize("dialect", ["standard", "matiec"])
def test_other_dialects_have_no_conditional_compilation(dialect: str) -> None:
    with pytest.raises(FileInvalid, match="conditional compilation is not in this dialect"):
        run("n : INT;", "{IF defined (A)} n := 1; {END_IF}", dialect=dialect)


PIECES = [
    "{IF defined (A)}",
    "{ELSIF defined (B)}",
    "{ELSE}",
    "{END_IF}",
    "{define A}",
    "{define B}",
    "'it'",
    "(* no *)",
    "x",
    "\n",
]


@given(st.lists(st.sampled_from(PIECES), max_size=20))
def test_a_text_keeps_its_lines_and_columns_or_has_an_error(pieces: list[str]) -> None:
    text = "".join(pieces)
    try:
        made = blanked(text, "test.st", DIALECTS["codesys"])
    except FileInvalid:
        return
    assert len(made) == len(text)
    assert [at for at, char in enumerate(made) if char == "\n"] == [at for at, char in enumerate(text) if char == "\n"]
    assert all(a in (" ", b) for a, b in zip(made, text, strict=True))
