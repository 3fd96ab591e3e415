"""Expressions and statements of CODESYS and TwinCAT: parts of results, chains of calls, characters of strings, and others."""

from __future__ import annotations

from typing import Any

import pytest
from st_bench import program, run

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.values import LogicError

POINT = """TYPE Point : STRUCT x, y : INT; row : ARRAY[1..3] OF INT; END_STRUCT END_TYPE
FUNCTION Made : Point VAR_INPUT n : INT; END_VAR Made.x := n; Made.row[2] := n * 2; END_FUNCTION
FUNCTION_BLOCK Builder
VAR total, calls : INT; END_VAR
METHOD Add : REFERENCE TO Builder VAR_INPUT n : INT; END_VAR
total := total + n; calls := calls + 1; Add REF= THIS^;
END_METHOD
METHOD Sum : INT Sum := total; END_METHOD
METHOD Place : POINTER TO INT calls := calls + 1; Place := ADR(total); END_METHOD
END_FUNCTION_BLOCK
"""


def codesys(variables: str, body: str, before: str = "") -> dict[str, Any]:
    return run(variables, body, before, dialect="codesys")


def test_a_member_and_an_element_of_the_result_of_a_function() -> None:
    found = codesys("a, b : INT;", "a := Made(3).x + 1; b := Made(n := 4).row[2];", POINT)
    assert (found["a"], found["b"]) == (4, 8)


def test_chains_of_method_calls() -> None:
    found = codesys("b : Builder; n : INT;", "b.Add(1).Add(2)\n  .Add(n := 3); n := b.Add(10).Sum();", POINT)
    assert (found["n"], found["b"].v_calls) == (16, 4)


def test_methods_through_a_pointer_and_the_variable_to_which_a_result_points() -> None:
    body = "p := ADR(b); p^.Add(5); n := p^.Sum(); b.Place()^ := 100; m := b.Place()^ + 1; p^.Place()^.2 := FALSE;"
    found = codesys("b : Builder; p : POINTER TO Builder; n, m : INT;", body, POINT)
    assert (found["n"], found["m"], found["b"].v_total, found["b"].v_calls) == (5, 101, 96, 4), "each call is made once"


def test_a_chain_in_a_condition_is_evaluated_only_if_it_is_needed() -> None:
    body = "IF no AND_THEN b.Add(1).Sum() > 0 THEN n := 1; ELSIF b.Add(2).Sum() = 2 THEN n := 2; END_IF"
    found = codesys("b : Builder; no : BOOL; n : INT;", body, POINT)
    assert (found["n"], found["b"].v_calls) == (2, 1)


def test_a_loop_evaluates_a_chain_in_its_condition_each_time() -> None:
    found = codesys("b : Builder; n : INT;", "WHILE b.Add(1).Sum() < 5 DO n := n + 1; END_WHILE", POINT)
    assert (found["n"], found["b"].v_total) == (4, 5)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("a := Made(3).z;", "in Point, a member 'z' is not declared"),
        ("a := Made(3)[1];", "an index into a value that is not an array"),
        ("a := b.Add(1).Nothing();", "in Builder, a method 'Nothing' is not declared"),
        ("Made(3).x := 1;", "cannot be assigned to"),
        ("a := b.Sum().y;", "a member"),
        ("a := No(3).y;", "a function 'No' is not declared"),
        ("a := Empty().y;", "Empty has no result"),
    ],
)
def test_wrong_parts_of_results_are_refused(body: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        codesys("a : INT; b : Builder;", body, POINT + "FUNCTION Empty END_FUNCTION")


def test_the_standard_has_no_parts_of_results() -> None:
    before = "TYPE P2 : STRUCT x : INT; END_STRUCT; END_TYPE FUNCTION F2 : P2 F2.x := 1; END_FUNCTION"
    with pytest.raises(FileInvalid, match=r"a part of the result of F2.*codesys and twincat"):
        run("a : INT;", "a := F2().x;", before)


def test_a_chain_of_assignments_assigns_from_right_to_left() -> None:
    found = codesys("a : REAL; b : INT; c : ARRAY[1..2] OF DINT;", "a := b := c[2] := 7;")
    assert (found["a"], found["b"], found["c"]) == (7.0, 7, [0, 7])
    with pytest.raises(FileInvalid, match="a := b := value is not in this dialect"):
        run("a, b : INT;", "a := b := 1;")


def test_initial_arrays_without_brackets_and_repetitions() -> None:
    found = codesys(
        "a : ARRAY[1..5] OF INT := 1, 2(7), 9; b : ARRAY[0..2] OF BOOL := 3(TRUE); c : ARRAY[1..2] OF INT := 4, 5;", ""
    )
    assert (found["a"], found["b"], found["c"]) == ([1, 7, 7, 9, 0], [True] * 3, [4, 5])
    with pytest.raises(FileInvalid, match="an initial array without brackets"):
        run("a : ARRAY[1..2] OF INT := 1, 2;", "")
    with pytest.raises(FileInvalid, match="more values than elements"):
        codesys("a : ARRAY[1..2] OF INT := 3(1);", "")
    with pytest.raises(FileInvalid, match="an array value for a type that is not an array"):
        codesys("a : INT := 1, 2;", "")


def test_numbers_of_an_enumeration_are_constant_expressions_of_constants_and_earlier_values() -> None:
    before = """VAR_GLOBAL CONSTANT base : INT := 10; END_VAR
    TYPE Late : (one := Early.last + 1, two); Early : (first := base, middle := 2 * first,
    last := ANY_TO_INT(7.6)) DINT; END_TYPE"""
    found = codesys("a, b, c, d : INT;", "a := Early.first; b := Early.middle; c := Late.one; d := Late.two;", before)
    assert [found[name] for name in "abcd"] == [10, 20, 9, 10]


def test_the_standard_also_has_constant_expressions_in_enumerations() -> None:
    assert run("a : E := E#b;", "", "TYPE E : (a := 2 * 3, b); END_TYPE")["a"] == 7


@pytest.mark.parametrize(
    ("declared", "message"),
    [
        (
            "TYPE E : (a := 1.5, b); END_TYPE",
            "the number of an enumerated value; expected a constant whole number; got",
        ),
        (
            "VAR_GLOBAL g : INT; END_VAR TYPE E : (a := g); END_TYPE",
            "a variable 'g' is not declared|g is not a constant",
        ),
        ("TYPE E : (a := b, b); END_TYPE", "'b' is not declared"),
        ("TYPE E : USINT (a := 100 * 3); END_TYPE", "a is outside USINT; expected 0 to 255; got 300"),
        ("TYPE E : (a := F.c); F : (c := E.a); END_TYPE", "contains itself"),
    ],
)
def test_wrong_numbers_of_enumerations_are_refused(declared: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        codesys("x : INT;", "", declared)


def test_characters_of_strings_are_bytes_that_can_be_read_and_written() -> None:
    before = """FUNCTION Upper : STRING(20)
    VAR_INPUT s : STRING(20); END_VAR VAR i : INT; t : STRING(20); END_VAR
    t := s;
    FOR i := 0 TO LEN(t) - 1 DO IF t[i] >= 97 AND t[i] <= 122 THEN t[i] := t[i] - 32; END_IF END_FOR
    t[LEN(t)] := 33; Upper := t;
    END_FUNCTION"""
    body = "a := Upper('pump 1'); b := s[1]; s[2] := 0; w := u[1]; names[2][0] := 16#41;"
    variables = "a, s : STRING := 'xyz'; b : BYTE; u : WSTRING := \"AB\"; w : WORD; "
    variables += "names : ARRAY[1..2] OF STRING(5) := ['', 'a'];"
    found = codesys(variables, body, before)
    assert (found["a"], found["b"], found["s"], found["w"], found["names"]) == ("PUMP 1!", 121, "xy", 66, ["", "A"])


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("b := s[81];", "an index outside its string; expected 0 to 80"),
        ("b := s[1, 2];", "indices; expected 1"),
        ("s[0] := 'a';", "expected BYTE; got STRING"),
    ],
)
def test_wrong_characters_are_refused(body: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        codesys("s : STRING; b : BYTE;", body)


def test_in_the_standard_a_character_is_a_char_counted_from_1() -> None:
    before = """FUNCTION First : CHAR VAR_INPUT t : STRING; END_VAR VAR u : STRING; END_VAR
    u := t; u[1] := 'z'; First := u[1]; END_FUNCTION"""
    variables = "s : STRING := 'ABC'; w : WSTRING := \"xy\"; a, b : CHAR; c : WCHAR; i : INT := 3; same : BOOL;"
    body = "a := s[2]; s[i] := 'D'; b := First('q'); c := w[2]; same := s[1] = 'A';"
    found = run(variables, body, before)
    assert (found["a"], found["s"], found["b"], found["c"], found["same"]) == ("B", "ABD", "z", "y", True)


@pytest.mark.parametrize("body", ["c := s[i];", "s[i] := 'x';"])
def test_a_character_after_the_end_of_the_string_stops_the_task(body: str) -> None:
    with pytest.raises(LogicError, match="after the end of its string; expected position 1 to 2; got 3"):
        run("s : STRING := 'ab'; c : CHAR; i : INT := 3;", body)
    with pytest.raises(FileInvalid, match="an index outside its string; expected 1 to 80"):
        run("s : STRING := 'ab'; c : CHAR;", "c := s[0];")


INTERFACES = """INTERFACE IA EXTENDS __System.IQueryInterface METHOD Get : INT END_METHOD END_INTERFACE
INTERFACE IB METHOD Other : INT END_METHOD END_INTERFACE
FUNCTION_BLOCK Both IMPLEMENTS IA, IB
METHOD PUBLIC Get : INT Get := 1; END_METHOD
METHOD PUBLIC Other : INT Other := 2; END_METHOD END_FUNCTION_BLOCK
FUNCTION_BLOCK Only IMPLEMENTS IA METHOD PUBLIC Get : INT Get := 3; END_METHOD END_FUNCTION_BLOCK
"""


def test_an_interface_of_an_instance_can_be_queried() -> None:
    body = """x := f; a := __QUERYINTERFACE(x, y); n := y.Other(); x := g; b := __QUERYINTERFACE(x, y); c := y = none;
    d := __QUERYINTERFACE(f, y); x := z; e := __QUERYINTERFACE(x, y);"""
    variables = "f : Both; g : Only; x, z : IA; y, none : IB; a, b, c, d, e : BOOL; n : INT;"
    found = codesys(variables, body, INTERFACES)
    assert [found[name] for name in "abcde"] == [True, False, True, True, False]
    assert found["n"] == 2


def test_an_assignment_attempt_between_interfaces() -> None:
    before = INTERFACES.replace(" EXTENDS __System.IQueryInterface", "")
    found = run(
        "f : Both; g : Only; x : IA; y, n : IB; a, b : BOOL;",
        "x := f; y ?= x; a := y <> n; x := g; y ?= x; b := y = n;",
        before,
    )
    assert (found["a"], found["b"]) == (True, True)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (
            "a := __QUERYINTERFACE(f, n);",
            "the second argument of __QUERYINTERFACE; expected a variable of an interface",
        ),
        ("a := __QUERYINTERFACE(n, y);", "the source of an assignment attempt; expected an interface or an instance"),
        ("y ?= n;", "the source of an assignment attempt"),
    ],
)
def test_wrong_queries_are_refused(body: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        codesys(
            "f : Both; y : IB; a : BOOL; n : INT;", body, INTERFACES.replace(" EXTENDS __System.IQueryInterface", "")
        )


@pytest.mark.parametrize(
    ("body", "construct"),
    [
        ("JMP far;", "labels and jumps"),
        ("far: x := 1;", "labels and jumps"),
        ("__TRY x := 1; __CATCH(e) __ENDTRY", "exceptions \\(__TRY, __CATCH\\)"),
        ("LD x\nADD 1\nST x\n", "bodies in instruction list \\(IL\\)"),
    ],
)
def test_constructs_that_are_not_supported_are_named(body: str, construct: str) -> None:
    with pytest.raises(FileInvalid, match=f"{construct} are not supported"):
        program(f"PROGRAM p VAR x : INT; END_VAR\n{body}\nEND_PROGRAM", "p", "codesys")


def test_an_error_names_the_whole_word_if_it_begins_with_a_keyword() -> None:
    with pytest.raises(FileInvalid, match=r"got done$"):
        program("PROGRAM p VAR done : BOOL; END_VAR\nJMP done;\nEND_PROGRAM", "p", "codesys")


def test_semicolons_and_comments_between_declarations_have_no_effect() -> None:
    text = """(* first *);
    TYPE T1 : STRUCT a : INT;; b : INT; END_STRUCT; END_TYPE; // second
    FUNCTION f : INT f := 10#12; END_FUNCTION;
    PROGRAM p VAR x : T1;; n : INT; END_VAR ;; n := f();; END_PROGRAM;"""
    made = program(text, "p")
    assert made.st_body.v_n == 0


def test_a_string_may_have_several_lines() -> None:
    found = codesys("s : STRING := 'two\n lines'; n : INT;", "n := LEN(s);")
    assert (found["s"], found["n"]) == ("two\n lines", 10)
    with pytest.raises(FileInvalid, match="a string that does not end; got 'two"):
        run("s : STRING := 'two\n lines';", "")
    with pytest.raises(FileInvalid, match="a string that does not end; got 'two"):
        codesys("s : STRING := 'two;", "")


def test_a_structure_may_have_no_members() -> None:
    before = "TYPE Nothing : STRUCT END_STRUCT END_TYPE"
    assert codesys("a, b : Nothing; n : INT;", "a := b; n := 1;", before)["n"] == 1
    with pytest.raises(FileInvalid, match="the structure Nothing has no members"):
        run("a : Nothing;", "", before)


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("STRING_TO_INT('12abc')", 12), ("STRING_TO_INT('-3.9')", -3), ("STRING_TO_INT('x1')", 0), ("STRING_TO_INT('')", 0),
        ("STRING_TO_INT('16#1Fz')", 31), ("TO_DINT(' 7')", 7),
    ],
)  # fmt: skip
def test_a_conversion_from_a_string_takes_the_number_at_its_beginning(expression: str, expected: int) -> None:
    assert codesys("n : DINT;", f"n := {expression};")["n"] == expected


def test_a_conversion_of_a_number_that_does_not_fit_stops_the_task() -> None:
    assert codesys("x : LREAL;", "x := STRING_TO_LREAL('3.25e1 bar');")["x"] == 32.5
    assert codesys("x : LREAL;", "x := STRING_TO_LREAL('bar');")["x"] == 0.0
    for text in ("40000", "9" * 50):
        with pytest.raises(LogicError, match="does not fit"):
            codesys("n : INT;", f"n := STRING_TO_INT('{text}');")
    with pytest.raises(LogicError, match="not a whole number"):
        run("n : INT;", "n := STRING_TO_INT('12abc');")
