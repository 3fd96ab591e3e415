"""EN and ENO of calls in text (IEC 61131-3:2013, 6.6.1.5, tables 18 and 20).

If EN is FALSE, the body is not executed and ENO is FALSE. The standard leaves the result open, and
docs/reference/structured-text.md states it.
"""

from __future__ import annotations

import pytest
from st_bench import program, run, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.dialects import DIALECTS
from fieldtwin.plc.st.program import program_class

COUNTED = """
VAR_GLOBAL calls : INT; END_VAR
FUNCTION doubled : INT
VAR_INPUT a : INT; END_VAR VAR_OUTPUT twice : INT; END_VAR VAR_EXTERNAL calls : INT; END_VAR
  calls := calls + 1; twice := 2 * a; doubled := twice;
END_FUNCTION
"""
DECLARED = """
FUNCTION checked : INT
VAR_INPUT EN : BOOL := TRUE; a : INT; END_VAR VAR_OUTPUT ENO : BOOL; END_VAR
  checked := a;
  IF a > 100 THEN ENO := FALSE; END_IF
END_FUNCTION
FUNCTION_BLOCK counter
VAR_INPUT EN : BOOL := TRUE; END_VAR VAR_OUTPUT ENO : BOOL; n : INT; END_VAR
  n := n + 1;
END_FUNCTION_BLOCK
"""


@pytest.mark.parametrize(("cond", "a", "eno"), [("TRUE", 5, True), ("FALSE", 0, False)])
def test_the_call_of_the_standard_with_en_and_eno(cond: str, a: int, eno: bool) -> None:
    """Table 20, feature 1b, calls LIMIT in this way."""
    found = run(
        "A, B : INT := 7; TEMPL : BOOL; COND : BOOL;",
        f"COND := {cond}; A := LIMIT(EN := COND, IN := B, MN := 0, MX := 5, ENO => TEMPL);",
    )
    assert (found["a"], found["templ"]) == (a, eno)


def test_a_function_is_not_executed_while_en_is_false() -> None:
    found = run(
        "x : INT; out, kept : INT := 9; yes, no : BOOL := FALSE; calls_after : INT;",
        """x := doubled(EN := x = 0, a := 4, twice => out, ENO => yes);
        x := x + doubled(EN := FALSE, a := 5, twice => kept, ENO => no);
        calls_after := calls;""",
        COUNTED,
    )
    assert (found["x"], found["out"], found["yes"]) == (8, 8, True)
    assert (found["kept"], found["no"]) == (9, False), "an output of a call that is not executed keeps its variable"
    assert found["calls_after"] == 1


def test_arguments_of_a_call_that_is_not_executed_are_not_evaluated() -> None:
    found = run("zero, x : INT; ok : BOOL := TRUE;", "x := ADD(IN1 := 1 / zero, IN2 := 2, EN := zero <> 0, ENO => ok);")
    assert (found["x"], found["ok"]) == (0, False)


def test_en_and_eno_may_be_given_alone() -> None:
    found = run("a, b : INT; ok : BOOL;", "a := doubled(EN := TRUE, a := 1); b := doubled(a := 2, ENO => ok);", COUNTED)
    assert (found["a"], found["b"], found["ok"]) == (2, 4, True)


def test_eno_may_be_inverted() -> None:
    found = run("failed : BOOL; x : INT;", "x := ADD(EN := FALSE, IN1 := 1, IN2 := 2, NOT ENO => failed);")
    assert found["failed"] is True


def test_a_result_of_constants_is_not_used_while_en_is_false() -> None:
    found = run(
        "r : REAL := 5.0; w : WORD := 7;",
        "r := MAX(EN := FALSE, IN1 := 1, IN2 := 2.5); w := SHL(EN := FALSE, IN := 1, N := 2);",
    )
    assert (found["r"], found["w"]) == (0.0, 0)


def test_a_structure_or_an_array_has_initial_values_while_en_is_false() -> None:
    before = """TYPE Pair : STRUCT x : INT := 3; END_STRUCT; Row : ARRAY[0..1] OF INT; END_TYPE
    FUNCTION paired : Pair paired.x := 8; END_FUNCTION
    FUNCTION row_of : Row row_of[1] := 8; END_FUNCTION"""
    found = run(
        "p : Pair := (x := 5); r : Row := [1, 2];", "p := paired(EN := FALSE); r := row_of(EN := FALSE);", before
    )
    assert (found["p"].m_x, found["r"]) == (3, [0, 0])


def test_a_function_without_a_result_may_have_en() -> None:
    before = "VAR_GLOBAL g : INT; END_VAR FUNCTION set VAR_EXTERNAL g : INT; END_VAR g := g + 1; END_FUNCTION"
    assert run("n : INT;", "set(EN := FALSE); set(EN := TRUE); n := g;", before)["n"] == 1


@pytest.mark.parametrize(("en", "elapsed", "ok"), [("TRUE", 10_000_000, True), ("FALSE", 0, False)])
def test_a_function_block_keeps_its_outputs_while_en_is_false(en: str, elapsed: int, ok: bool) -> None:
    made = program(
        f"""PROGRAM p VAR t : TON; ok : BOOL; et : TIME; END_VAR
        t(EN := {en}, IN := TRUE, PT := T#1s, ENO => ok, ET => et); END_PROGRAM"""
    )
    scan(made, 1)
    scan(made, 2)
    assert (made.st_body.v_et, made.st_body.v_ok) == (elapsed, ok)


def test_inputs_of_a_function_block_keep_their_values_while_en_is_false() -> None:
    found = run("t : TON; pt : TIME;", "t(PT := T#5s); t(EN := FALSE, PT := T#1s); pt := t.PT;")
    assert found["pt"] == 5_000_000_000


def test_a_declared_eno_may_be_set_to_false_by_the_body() -> None:
    found = run(
        "x, y, z : INT; a, b, c : BOOL;",
        "x := checked(a := 5, ENO => a); y := checked(a := 101, ENO => b); z := checked(EN := FALSE, a := 5, ENO => c);",
        DECLARED,
    )
    assert (found["x"], found["a"]) == (5, True)
    assert (found["y"], found["b"]) == (101, False)
    assert (found["z"], found["c"]) == (0, False)


def test_a_block_with_declared_en_is_not_executed_while_it_is_false() -> None:
    found = run("c : counter; n : INT;", "c(); c(EN := FALSE); c.EN := TRUE; c(); n := c.n;", DECLARED, scans=2)
    assert (found["n"], found["c"].v_eno) == (4, True)


def test_in_codesys_declared_en_and_eno_are_ordinary_variables() -> None:
    text = DECLARED + "PROGRAM p VAR c : counter; n : INT; END_VAR c(EN := FALSE); n := c.n; END_PROGRAM"
    made = program_class(compile_text(text, "test.st", DIALECTS["codesys"]), "p")()
    scan(made)
    assert made.st_body.v_n == 1


def test_only_the_branch_of_a_condition_that_is_needed_calls() -> None:
    found = run(
        "x : INT; b : BOOL; ok : BOOL := TRUE;",
        "b := (x = 1) AND_THEN (doubled(EN := TRUE, a := 1, ENO => ok) = 2); x := calls;",
        COUNTED,
    )
    assert (found["x"], found["b"], found["ok"]) == (0, False, True)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("x := doubled(EN := 1.5, a := 1);", "the condition of EN"),
        ("x := doubled(a := 1, ENO => x);", "INT"),
        ("x := doubled(EN := TRUE, EN := FALSE, a := 1);", "EN of doubled is given twice"),
        ("x := doubled(a := 1, ENO := x);", "ENO"),
    ],
)
def test_a_wrong_en_or_eno_is_an_error(body: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        run("x : INT;", body, COUNTED)


def test_an_initial_value_has_no_en() -> None:
    with pytest.raises(FileInvalid, match="a constant expression"):
        run("x : INT := ADD(EN := TRUE, IN1 := 1, IN2 := 2);", ";")
