"""Arrays of variable length: ARRAY[*], LOWER_BOUND and UPPER_BOUND (IEC 61131-3:2013, 6.5.3 and table 15)."""

from __future__ import annotations

import pytest
from st_bench import run

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.values import LogicError

SUM = """FUNCTION SUM : DINT
VAR_IN_OUT A : ARRAY[*] OF INT; END_VAR
VAR i, sum2 : DINT; END_VAR
  sum2 := 0;
  FOR i := LOWER_BOUND(A, 1) TO UPPER_BOUND(A, 1) DO
    sum2 := sum2 + A[i];
  END_FOR
  SUM := sum2;
END_FUNCTION
"""


def test_the_example_of_the_standard() -> None:
    found = run(
        "A1 : ARRAY[1..10] OF INT := [10(1)]; A2 : ARRAY[-3..2] OF INT := [1, 2, 3, 4, 5, 6]; s1, s2 : DINT;",
        "s1 := SUM(A1); s2 := SUM(A := A2);",
        SUM,
    )
    assert (found["s1"], found["s2"]) == (10, 21)


def test_an_in_out_changes_the_array_of_the_caller() -> None:
    before = """FUNCTION fill VAR_INPUT x : INT; END_VAR VAR_IN_OUT a : ARRAY[*, *] OF INT; END_VAR
      a[LOWER_BOUND(a, 1), UPPER_BOUND(ARR := a, DIM := 2)] := x; END_FUNCTION
    FUNCTION_BLOCK outer VAR_IN_OUT b : ARRAY[*, *] OF INT; END_VAR fill(7, b); END_FUNCTION_BLOCK"""
    found = run("m : ARRAY[2..3, 5..6] OF INT; o : outer;", "o(b := m);", before)
    assert found["m"] == [[0, 7], [0, 0]]


def test_an_input_is_a_copy() -> None:
    before = """TYPE P : STRUCT n : INT; END_STRUCT; END_TYPE
    FUNCTION first : INT VAR_INPUT a : ARRAY[*] OF P; END_VAR VAR i : DINT; END_VAR
    first := a[LOWER_BOUND(a, 1)].n; change(a); first := first * 100 + a[LOWER_BOUND(a, 1)].n; END_FUNCTION
    FUNCTION change VAR_IN_OUT a : ARRAY[*] OF P; END_VAR a[LOWER_BOUND(a, 1)].n := 9; END_FUNCTION"""
    with pytest.raises(FileInvalid, match="a cannot be assigned to"):
        run("p : ARRAY[4..5] OF P; n : INT;", "n := first(p);", before)
    found = run("p : ARRAY[4..5] OF P; n : INT;", "p[4].n := 3; n := first(p);", before.replace("change(a);", ""))
    assert (found["n"], found["p"][0].m_n) == (303, 3)


FILL = """FUNCTION fill VAR_INPUT x : INT; END_VAR VAR_OUTPUT a : ARRAY[*] OF INT; last : DINT; END_VAR VAR i : DINT; END_VAR
  last := UPPER_BOUND(a, 1);
  FOR i := LOWER_BOUND(a, 1) TO last DO
    a[i] := a[i] + x + DINT_TO_INT(i);
  END_FOR
END_FUNCTION
"""


def test_an_output_has_the_limits_of_the_array_of_the_caller_and_begins_with_initial_values() -> None:
    found = run(
        "m : ARRAY[2..4] OF INT := [3(50)]; n : ARRAY[0..1] OF INT; last : DINT;",
        "fill(x := 10, a => m, last => last); fill(20, n);",
        FILL,
    )
    assert (found["m"], found["n"], found["last"]) == ([12, 13, 14], [20, 21], 4)


def test_an_output_does_not_share_the_array_of_an_in_out() -> None:
    before = """FUNCTION reverse
      VAR_IN_OUT a : ARRAY[*] OF INT; END_VAR VAR_OUTPUT b : ARRAY[*] OF INT; END_VAR VAR i : DINT; END_VAR
      FOR i := LOWER_BOUND(a, 1) TO UPPER_BOUND(a, 1) DO
        b[LOWER_BOUND(b, 1) + UPPER_BOUND(a, 1) - i] := a[i];
      END_FOR
    END_FUNCTION"""
    assert run("m : ARRAY[1..3] OF INT := [1, 2, 3];", "reverse(a := m, b => m);", before)["m"] == [3, 2, 1]


def test_an_output_of_two_dimensions_is_passed_on_to_a_method() -> None:
    before = """TYPE Cell : STRUCT n : INT := 7; s : STRING[3]; END_STRUCT; END_TYPE
    FUNCTION_BLOCK Maker
      METHOD PUBLIC make : INT VAR_OUTPUT made : ARRAY[*, *] OF Cell; END_VAR
        made[LOWER_BOUND(made, 1), UPPER_BOUND(made, 2)].s := 'ab';
        make := made[1, 5].n;
      END_METHOD
    END_FUNCTION_BLOCK
    FUNCTION outer : INT VAR_IN_OUT maker : Maker; END_VAR VAR_OUTPUT got : ARRAY[*, *] OF Cell; END_VAR
      outer := maker.make(made => got); got[2, 5].n := outer + 1;
    END_FUNCTION"""
    found = run("m : ARRAY[1..2, 5..6] OF Cell; maker : Maker; n : INT;", "n := outer(maker, got => m);", before)
    assert [[(one.m_n, one.m_s) for one in row] for row in found["m"]] == [[(7, ""), (7, "ab")], [(8, ""), (7, "")]]
    assert found["n"] == 7


def test_while_en_is_false_an_output_of_variable_length_keeps_the_array() -> None:
    found = run(
        "m : ARRAY[0..1] OF INT := [8, 9]; ok : BOOL := TRUE;", "fill(EN := FALSE, x := 1, a => m, ENO => ok);", FILL
    )
    assert (found["m"], found["ok"]) == ([8, 9], False)


def test_bounds_of_an_ordinary_array() -> None:
    found = run(
        "a : ARRAY[1..3, -2..7] OF BOOL; d : DINT := 2; b : ARRAY[0..3] OF DINT;",
        "b[0] := LOWER_BOUND(a, 1); b[1] := UPPER_BOUND(a, 2); b[2] := LOWER_BOUND(a, d); b[3] := UPPER_BOUND(a, 1);",
    )
    assert found["b"] == [1, 7, -2, 3]


@pytest.mark.parametrize("index", ["LOWER_BOUND(A, 1) - 1", "UPPER_BOUND(A, 1) + 1"])
def test_an_index_outside_the_array_of_the_caller_stops_the_task(index: str) -> None:
    before = f"FUNCTION f : INT VAR_IN_OUT A : ARRAY[*] OF INT; END_VAR f := A[{index}]; END_FUNCTION"
    with pytest.raises(LogicError, match="an index outside its array") as e:
        run("a : ARRAY[4..6] OF INT; x : INT;", "x := f(a);", before)
    assert e.value.expected == "4 to 6"


def test_a_dimension_that_does_not_exist_stops_the_task() -> None:
    with pytest.raises(LogicError, match="a dimension"):
        run("a : ARRAY[4..6] OF INT; d : INT := 2; x : DINT;", "x := UPPER_BOUND(a, d);")


@pytest.mark.parametrize(
    ("before", "body", "message"),
    [
        ("", "x := SUM(b);", "ARRAY\\[\\*\\] OF INT"),
        ("", "x := SUM(c);", "ARRAY\\[\\*\\] OF INT"),
        ("", "x := UPPER_BOUND(a, 2);", "a dimension"),
        ("", "x := UPPER_BOUND(x, 1);", "an array"),
        ("FUNCTION g VAR_IN_OUT a, b : ARRAY[*] OF INT; END_VAR a := b; END_FUNCTION", ";", "variable length"),
        ("FUNCTION g VAR_INPUT a : ARRAY[*] OF INT; END_VAR ; END_FUNCTION", "g();", "needs an array"),
        ("FUNCTION g VAR_IN_OUT a : ARRAY[*] OF INT; END_VAR a[1, 2] := 3; END_FUNCTION", ";", "indices"),
        (FILL, "fill(3);", "a of fill needs an array"),
        (FILL, "fill(3, a => b);", r"ARRAY\[\*\] OF INT"),
        (FILL, "fill(3, NOT a => a);", r"NOT before the output a; expected a BOOL; got ARRAY\[\*\] OF INT"),
        (FILL, "fill(3, a => a, NOT last => x);", "NOT before the output last; expected a BOOL; got DINT"),
        (FILL, "fill(3, a => k);", "k cannot be assigned to"),
        ("FUNCTION_BLOCK g VAR_OUTPUT a : ARRAY[*] OF INT; END_VAR ; END_FUNCTION_BLOCK", "y();", "use VAR_IN_OUT"),
        ("FUNCTION g VAR_OUTPUT a : ARRAY[*] OF INT := [1]; END_VAR ; END_FUNCTION", ";", "an array value"),
        ("FUNCTION g VAR a : ARRAY[*] OF INT; END_VAR ; END_FUNCTION", ";", "variable length"),
        ("FUNCTION_BLOCK g VAR_INPUT a : ARRAY[*] OF INT; END_VAR ; END_FUNCTION_BLOCK", "y();", "variable length"),
        ("TYPE T1 : ARRAY[*] OF INT; END_TYPE", ";", "variable length"),
        ("FUNCTION g VAR_IN_OUT a : ARRAY[*, 1..2] OF INT; END_VAR ; END_FUNCTION", ";", "in some dimensions only"),
    ],
)
def test_a_wrong_use_of_an_array_of_variable_length_is_an_error(before: str, body: str, message: str) -> None:
    block = "y : g;" if "FUNCTION_BLOCK" in before else ""
    with pytest.raises(FileInvalid, match=message):
        run(
            "a : ARRAY[0..1] OF INT; END_VAR VAR CONSTANT k : ARRAY[0..1] OF INT; END_VAR VAR "
            f"b : ARRAY[0..1] OF DINT; c : ARRAY[0..1, 0..1] OF INT; x : DINT; {block}",
            body,
            SUM + before,
        )
