"""FOR and VAR_IN_OUT: the control variable after a loop, statements that must not change it, and variables passed by
reference.

Defects: an assignment to the control variable was ignored, two nested loops could share one, a loop that did not run left it
unchanged and after ``1 TO 10`` it was 10. A variable that was passed twice was copied in and out, so that one result was lost.
"""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from st_bench import program, run, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.program import ScanTooLong
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.dialects import DIALECTS
from fieldtwin.plc.st.values import LogicError


def c_loop(first: int, last: int, by: int) -> tuple[list[int], int]:
    """The loop as matiec and CODESYS write it: initial value, test, body, step."""
    seen, i = [], first
    while i <= last if by > 0 else i >= last:
        seen.append(i)
        i += by
    return seen, i


@settings(deadline=None, max_examples=60)
@given(st.integers(-40, 40), st.integers(-40, 40), st.integers(-7, 7).filter(bool))
def test_a_for_runs_and_ends_like_the_loop_of_matiec(first: int, last: int, by: int) -> None:
    seen, after = c_loop(first, last, by)
    body = f"i := 99; FOR i := {first} TO {last} BY {by} DO n := n + 1; s := 3 * s + i; END_FOR"
    total = 0
    for i in seen:
        total = 3 * total + i
    got = run("i, n : INT; s : LINT;", body)
    wrapped = (total + 2**63) % 2**64 - 2**63
    assert (got["i"], got["n"], got["s"]) == (after, len(seen), wrapped)


def test_the_control_variable_after_the_loop() -> None:
    def after(loop: str) -> object:
        return run("i : INT := 77; k : INT;", loop)["i"]

    assert after("FOR i := 1 TO 10 DO ; END_FOR") == 11  # so that IF i > 10 shows that nothing was found
    assert after("FOR i := 5 TO 1 DO ; END_FOR") == 5
    assert after("FOR i := 1 TO 10 DO IF i = 4 THEN EXIT; END_IF; END_FOR") == 4
    assert after("FOR i := 1 TO 10 DO IF i >= 10 THEN EXIT; END_IF; END_FOR") == 10
    assert after("FOR i := 1 TO 10 DO IF i > 2 THEN CONTINUE; END_IF; k := i; END_FOR") == 11
    assert after("FOR i := 10 TO 1 BY -4 DO ; END_FOR") == -2


def test_a_loop_to_the_last_value_of_its_type_ends_and_wraps() -> None:
    assert run("i : SINT; n : INT;", "FOR i := 120 TO 127 DO n := n + 1; END_FOR") | {} == {"i": -128, "n": 8}
    assert run("i : USINT; n : INT;", "FOR i := 250 TO 255 BY 3 DO n := n + 1; END_FOR")["i"] == 0
    huge = run(
        "i : LINT; n : INT;", "FOR i := LINT#9223372036854775806 TO LINT#9223372036854775807 DO n := n + 1; END_FOR"
    )
    assert (huge["i"], huge["n"]) == (-(2**63), 2)


def test_limits_and_step_are_worked_out_once() -> None:
    got = run(
        "i, n, top, by : INT;", "top := 3; by := 1; FOR i := 1 TO top BY by DO top := 9; by := 5; n := n + 1; END_FOR"
    )
    assert (got["i"], got["n"]) == (4, 3)


TYPES = """TYPE S : STRUCT i, j : INT; END_STRUCT; END_TYPE
FUNCTION f : INT VAR_IN_OUT x : INT; END_VAR x := x + 1; f := x; END_FUNCTION
FUNCTION g : INT VAR_OUTPUT o : INT; END_VAR o := 5; g := 1; END_FUNCTION
FUNCTION_BLOCK B VAR_IN_OUT x : INT; s : S; END_VAR VAR_OUTPUT o : INT; END_VAR x := x + 1; END_FUNCTION_BLOCK
"""


@pytest.mark.parametrize(
    "body",
    [
        "FOR i := 1 TO 9 DO\ni := 20; END_FOR",
        "FOR i := 1 TO 9 DO IF TRUE THEN\ni := i + 1; END_IF END_FOR",
        "FOR i := 1 TO 9 DO\nFOR i := 1 TO 2 DO ; END_FOR END_FOR",
        "FOR i := 1 TO 9 DO FOR k := 1 TO 2 DO\nI := 3; END_FOR END_FOR",
        "FOR i := 1 TO 9 DO\ni.0 := TRUE; END_FOR",
        "FOR i := 1 TO 9 DO\nk := f(i); END_FOR",
        "FOR i := 1 TO 9 DO\nk := g(o => i); END_FOR",
        "FOR i := 1 TO 9 DO\nb(x := i, s := t); END_FOR",
        "FOR i := 1 TO 9 DO\nb(x := k, s := t, o => i); END_FOR",
        "FOR s.i := 1 TO 9 DO\ns.i := 2; END_FOR",
        "FOR s.i := 1 TO 9 DO\ns := t; END_FOR",
        "FOR s.i := 1 TO 9 DO\nb(x := k, s := s); END_FOR",
    ],
)
def test_altering_the_control_variable_in_the_loop_is_refused(body: str) -> None:
    with pytest.raises(FileInvalid, match="is the control variable of the FOR around this statement") as e:
        run("i, k : INT; s, t : S; b : B;", body, TYPES)
    assert e.value.line == 8


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("FOR i := 1 TO 9 DO k := k + 1; i := i + 2; END_FOR", (10, 3)),
        ("FOR i := 1 TO 9 DO k := k + 1; i := 20; END_FOR", (21, 1)),
        ("FOR i := 9 TO 1 BY -3 DO k := k + 1; IF k = 1 THEN i := 7; CONTINUE; END_IF END_FOR", (-2, 3)),
        ("FOR i := 5 TO 1 DO i := 3; k := 1; END_FOR", (5, 0)),
        ("FOR i := 1 TO 9 DO k := k + 1; i := 4; EXIT; END_FOR", (4, 1)),
        ("FOR i := 1 TO 3 DO k := k + 1; FOR i := 1 TO 5 DO k := k + 10; END_FOR END_FOR", (7, 51)),
        ("FOR i := 32766 TO 32767 DO k := k + 1; i := i; END_FOR", (-32768, 2)),
        ("FOR i := 1 TO 9 DO k := k + 1; up(i); END_FOR", (10, 3)),
        ("FOR i := 1 TO 2 DO i := i + 5; END_FOR; FOR i := 1 TO 3 DO k := k + 1; END_FOR", (4, 3)),
    ],
)
def test_codesys_continues_with_the_altered_control_variable(body: str, expected: tuple[int, int]) -> None:
    """CODESYS has a rule of its static analysis about such loops (SA0072), and compiles them."""
    before = "FUNCTION up VAR_IN_OUT n : INT; END_VAR n := n + 2; END_FUNCTION"
    found = run("i, k : INT;", body, before, dialect="codesys")
    assert (found["i"], found["k"]) == expected
    warnings = compile_text(
        f"{before} PROGRAM p VAR i, k : INT; END_VAR {body} END_PROGRAM", "p.st", DIALECTS["codesys"]
    ).warnings
    assert {one.id for one in warnings} >= {"ST011"}


def test_a_loop_that_sets_its_control_variable_back_is_endless() -> None:
    with pytest.raises(ScanTooLong):
        run("i : INT;", "FOR i := 1 TO 9 DO i := i - 1; END_FOR", dialect="codesys")


def test_other_variables_and_later_loops_are_free() -> None:
    got = run(
        "i, k : INT; s : S;",
        """FOR i := 1 TO 3 DO s.i := i; FOR s.j := 1 TO 2 DO s.i := s.i + 1; k := k + 1; END_FOR END_FOR
        i := 50; FOR i := 1 TO 2 DO ; END_FOR""",
        TYPES,
    )
    assert (got["i"], got["k"], got["s"].m_i, got["s"].m_j) == (3, 6, 5, 3)


@pytest.mark.parametrize("variable", ["a[1]", "t.IN", "a[i]"])
def test_an_element_of_an_array_or_a_blocks_input_is_not_a_control_variable(variable: str) -> None:
    with pytest.raises(FileInvalid, match="the variable of FOR"):
        run("a : ARRAY[1..3] OF INT; i : INT; t : TON;", f"FOR {variable} := 1 TO 3 DO ; END_FOR")


def test_a_pou_that_alters_a_global_control_variable_stops_the_task_with_the_line() -> None:
    text = """VAR_GLOBAL i, n : INT; END_VAR
    FUNCTION skip : INT VAR_INPUT at : INT; END_VAR IF i = at THEN i := i + 1; END_IF; skip := i; END_FUNCTION
    PROGRAM p VAR at : INT; r : INT; END_VAR
    FOR i := 1 TO 5 DO
    r := skip(at); n := n + 1; IF i = 2 THEN CONTINUE; END_IF; END_FOR END_PROGRAM"""
    fine = program(text)
    scan(fine)
    assert (fine.st_resource.globals.v_i, fine.st_resource.globals.v_n) == (6, 5)
    wrong = program(text.replace("at : INT; r", "at : INT := 3; r"))
    with pytest.raises(LogicError, match="control variable of a FOR was altered"):
        scan(wrong)


# -- VAR_IN_OUT -----------------------------------------------------------------------------------------------------------

HANDED = """TYPE S : STRUCT n : INT; t : STRING[3]; a : ARRAY[1..2] OF INT; END_STRUCT; END_TYPE
VAR_GLOBAL g : INT; END_VAR
FUNCTION both : INT VAR_IN_OUT a, b : INT; END_VAR
  a := a + 1; b := b + 10; both := a + b; END_FUNCTION
FUNCTION twice : INT VAR_IN_OUT a : INT; END_VAR VAR x : INT; END_VAR
  x := both(a, a); g := g + 100; a := a + 1000; twice := a; END_FUNCTION
FUNCTION own : INT VAR_INPUT from : INT; END_VAR VAR l : INT; END_VAR
  l := from; own := both(l, l); own := own + l; END_FUNCTION
FUNCTION append : INT VAR_IN_OUT t : STRING[10]; END_VAR t := CONCAT(t, 'xyz'); append := LEN(t); END_FUNCTION
FUNCTION_BLOCK Add VAR_IN_OUT a, b : INT; END_VAR VAR_OUTPUT seen : INT; END_VAR VAR_TEMP t : INT; END_VAR
  a := a + 1; t := a; t := both(t, b); seen := b; END_FUNCTION_BLOCK
"""


def test_a_variable_that_is_passed_twice_is_one_variable() -> None:
    for variable in ("n", "s.n", "l[2]", "g", "p.a[2]"):
        got = run("n, r : INT; s, p : S; l : ARRAY[1..3] OF INT;", f"r := both({variable}, {variable});", HANDED)
        assert got["r"] == 22, variable
    assert run("n, r : INT;", "r := both(a := n, b := n);", HANDED)["n"] == 11
    assert run("s : S; b : Add; r : INT;", "b(a := s.n, b := s.n); r := b.seen;", HANDED)["r"] == 11
    assert run("l : ARRAY[1..2] OF INT; r : INT;", "r := both(l[1], l[2]);", HANDED)["l"] == [1, 10]


def test_a_global_variable_that_is_passed_is_the_one_that_the_pou_sees() -> None:
    made = program(HANDED + "PROGRAM p VAR r : INT; END_VAR r := twice(g); END_PROGRAM")
    scan(made)
    assert (made.st_resource.globals.v_g, made.st_body.v_r) == (1111, 1111)


def test_a_functions_own_variable_can_be_handed_over() -> None:
    assert run("r : INT;", "r := own(5);", HANDED)["r"] == 16 + 16 + 16


def test_the_element_that_is_passed_is_the_one_at_the_beginning_of_the_call() -> None:
    before = HANDED + "FUNCTION move : INT VAR_IN_OUT i, e : INT; END_VAR i := 3; e := 7; move := 0; END_FUNCTION\n"
    got = run("i, r : INT := 1; l : ARRAY[1..3] OF INT;", "r := move(i, l[i]);", before)
    assert (got["i"], got["l"]) == (3, [7, 0, 0])


def test_a_shorter_string_keeps_its_length() -> None:
    got = run(
        "s : S; r : INT; t : STRING[20] := 'ab';", "s.t := 'ab'; r := append(s.t); r := 10 * r + append(t);", HANDED
    )
    assert (got["s"].m_t, got["t"]) == ("abx", "abxyz")


def test_a_structure_assigned_as_a_whole_changes_a_reference_to_its_part() -> None:
    before = (
        HANDED
        + """FUNCTION whole : INT VAR_IN_OUT s : S; a : ARRAY[1..2] OF INT; END_VAR VAR new : S; END_VAR
      new.a[1] := 8; s := new; a[2] := 9; whole := a[1]; END_FUNCTION\n"""
    )
    got = run("s : S; r : INT;", "r := whole(s, s.a);", before)
    assert (got["s"].m_a, got["r"]) == ([8, 9], 8)


def test_a_subrange_is_not_handed_over_as_its_base_type() -> None:
    with pytest.raises(FileInvalid, match=r"VAR_IN_OUT a of both; expected INT; got INT\(0..5\)"):
        run("n : INT(0..5); m, r : INT;", "r := both(n, m);", HANDED)


@settings(deadline=None, max_examples=40)
@given(st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from("abc"), st.integers(0, 9)), min_size=1, max_size=6))
def test_in_outs_are_references_as_in_a_language_that_has_them(calls: list[tuple[str, str, int]]) -> None:
    before = """FUNCTION mix : INT VAR_IN_OUT x, y : INT; END_VAR VAR_INPUT k : INT; END_VAR
      x := x + k; y := 2 * y - x; mix := x; END_FUNCTION\n"""
    cells = {"a": 1, "b": 2, "c": 3}

    def narrowed(n: int) -> int:
        return (n + 2**15) % 2**16 - 2**15

    for x, y, k in calls:
        cells[x] = narrowed(cells[x] + k)
        cells[y] = narrowed(2 * cells[y] - cells[x])
    body = " ".join(f"r := mix(x := {x}, y := {y}, k := {k});" for x, y, k in calls)
    got = run("a : INT := 1; b : INT := 2; c : INT := 3; r : INT;", body, before)
    assert {name: got[name] for name in "abc"} == cells
