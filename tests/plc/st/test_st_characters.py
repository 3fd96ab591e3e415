"""CHAR and WCHAR: literals, implicit conversions and conversion functions (IEC 61131-3:2013, tables 7, 10, 11, 23 and 26)."""

from __future__ import annotations

from typing import Any

import pytest
from st_bench import program as compiled
from st_bench import run, scan, value

from fieldtwin.gateway.core.errors import FileInvalid


def test_the_initial_value_is_the_character_0() -> None:
    found = run("c : CHAR; w : WCHAR; a : ARRAY[0..1] OF CHAR; d : CHAR := 'B'; e : WCHAR := \"€\";", ";")
    assert [found[name] for name in "cwade"] == ["\0", "\0", ["\0", "\0"], "B", "€"]


@pytest.mark.parametrize(
    ("kind", "expression", "expected"),
    [
        ("CHAR", "'x'", "x"),
        ("CHAR", "CHAR#'x'", "x"),
        ("CHAR", "char#'$41'", "A"),
        ("CHAR", "'$N'", "\n"),
        ("WCHAR", 'WCHAR#"$20AC"', "€"),
        ("STRING", "STRING#'OK'", "OK"),
        ("WSTRING", 'WSTRING#"OK"', "OK"),
        ("STRING", "CHAR#'x'", "x"),
        ("STRING", "CONCAT(CHAR#'a', 'b', STRING#'c')", "abc"),
        ("INT", "FIND('abc', CHAR#'c')", 3),
        ("BYTE", "CHAR_TO_BYTE('A')", 65),
        ("DWORD", "CHAR_TO_DWORD('A')", 65),
        ("WORD", 'WCHAR_TO_WORD("€")', 0x20AC),
        ("CHAR", "BYTE_TO_CHAR(66)", "B"),
        ("CHAR", "WORD_TO_CHAR(WORD#16#0142)", "B"),
        ("WCHAR", "WORD_TO_WCHAR(16#20AC)", "€"),
        ("CHAR", "STRING_TO_CHAR('xyz')", "x"),
        ("CHAR", "STRING_TO_CHAR('')", "\0"),
        ("WCHAR", 'WSTRING_TO_WCHAR("xyz")', "x"),
        ("STRING", "CHAR_TO_STRING('x')", "x"),
        ("WSTRING", 'WCHAR_TO_WSTRING("x")', "x"),
        ("WCHAR", "CHAR_TO_WCHAR('x')", "x"),
        ("CHAR", 'WCHAR_TO_CHAR("x")', "x"),
        ("BOOL", "CHAR#'a' < CHAR#'b'", True),
        ("CHAR", "MAX(CHAR#'a', CHAR#'b')", "b"),
        ("CHAR", "SEL(TRUE, CHAR#'a', CHAR#'b')", "b"),
    ],
)
def test_literals_and_conversions(kind: str, expression: str, expected: Any) -> None:
    assert value(kind, expression) == expected


def test_characters_are_compared_and_assigned() -> None:
    found = run(
        "c : CHAR := 'q'; s : STRING := 'ab'; b : ARRAY[0..2] OF BOOL; d : CHAR;",
        "b[0] := c = 'q'; b[1] := c <> CHAR#'q'; d := STRING_TO_CHAR(RIGHT(s, 1)); b[2] := d = 'b'; s := c;",
    )
    assert (found["b"], found["s"]) == ([True, False, True], "q")


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("c := 'xy';", "CHAR"),
        ("c := s;", "STRING_TO_CHAR|CHAR"),
        ('c := "x";', "CHAR"),
        ("w := c;", "CHAR_TO_WCHAR"),
        ("c := 65;", "CHAR"),
        ("c := c + c;", "operands of \\+"),
        ("c := CHAR#'ab';", "a CHAR is one character"),
        ("c := CHAR#'';", "a CHAR is one character"),
        ("i := CHAR_TO_INT(c);", "no conversion from CHAR to INT"),
        ("b := WCHAR_TO_BYTE(w);", "no conversion from WCHAR to BYTE"),
        ("c := WCHAR#'a';", "not Structured Text|WCHAR"),
    ],
)
def test_a_wrong_use_of_characters_is_an_error(body: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        run("c : CHAR; w : WCHAR; s : STRING[1]; i : INT; b : BYTE;", body)


def test_a_character_is_not_a_tag_and_is_shown_and_retained() -> None:
    with pytest.raises(FileInvalid, match="c cannot be bound to a tag"):
        compiled("PROGRAM p VAR_OUTPUT c : CHAR; END_VAR ; END_PROGRAM")
    text = "PROGRAM p VAR RETAIN c : CHAR; END_VAR IF c = 'a' THEN c := 'b'; ELSE c := 'a'; END_IF END_PROGRAM"
    first, second = compiled(text), compiled(text)
    scan(first)
    second.restore(first.retained())
    scan(second)
    shown = second.internal("c")
    assert shown is not None
    assert (shown.type, shown.value) == ("CHAR", "'b'")
