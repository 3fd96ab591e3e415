"""References of the standard: REF_TO, REF(), ``^``, NULL, comparisons and ``?=`` (IEC 61131-3:2013, 6.4.4.10 and table 12)."""

from __future__ import annotations

import copy
import json

import pytest
from st_bench import program, run, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.values import LogicError

TYPES = "TYPE S1 : STRUCT SC1 : INT; SC2 : REAL; END_STRUCT; A1 : ARRAY[1..99] OF INT; END_TYPE"
DECLARED = """myS1 : S1; myA1 : A1;
myRefS1 : REF_TO S1 := REF(myS1); myRefA1 : REF_TO A1 := REF(myA1); myRefInt : REF_TO INT := REF(myA1[1]);"""


def test_the_example_of_the_standard() -> None:
    found = run(
        DECLARED + "a, b : INT;",
        """myA1[12] := 1200; myA1[11] := 1100; myA1[1] := 100;
        myRefS1^.SC1 := myRefA1^[12]; a := myS1.SC1; b := myRefInt^;
        myRefInt := REF(myA1[11]); myS1.SC1 := myRefInt^;""",
        TYPES,
    )
    assert (found["a"], found["b"], found["mys1"].m_sc1) == (1200, 100, 1100)


def test_an_assignment_through_a_reference_changes_the_variable() -> None:
    found = run(
        DECLARED + "s : S1 := (SC1 := 7, SC2 := 2.5);",
        "myRefInt^ := 5; myRefS1^ := s; s.SC1 := 9; myRefA1^[2] := 6;",
        TYPES,
    )
    assert found["mya1"][:2] == [5, 6]
    assert (found["mys1"].m_sc1, found["mys1"].m_sc2) == (7, 2.5), "the structure is copied, not shared"


def test_a_reference_to_a_reference() -> None:
    found = run("x : INT := 3; r : REF_TO INT; rr : REF_TO REF_TO INT;", "r := REF(x); rr := REF(r); rr^^ := 8;")
    assert found["x"] == 8


def test_references_to_one_variable_are_equal() -> None:
    found = run(
        "a : ARRAY[0..3] OF INT; s : ARRAY[0..1] OF INT; r, q : REF_TO INT; w, v : REF_TO ARRAY[0..1] OF INT;"
        "b : ARRAY[0..6] OF BOOL;",
        """b[0] := r = NULL; r := REF(a[1]); q := REF(a[1]); b[1] := r = q; b[2] := r <> NULL; q := REF(a[2]); b[3] := r <> q;
        q := NULL; b[4] := q = NULL; w := REF(s); v := REF(s); b[5] := w = v; b[6] := NULL = r;""",
    )
    assert found["b"] == [True, True, True, True, True, True, False]


@pytest.mark.parametrize("body", ["x := r^;", "r^ := 1;", "s := t^; ", "x := t^.m[2];", "f(io := r^);"])
def test_null_that_is_used_stops_the_task(body: str) -> None:
    before = """TYPE T1 : STRUCT m : ARRAY[1..2] OF INT; END_STRUCT; END_TYPE
    FUNCTION_BLOCK fb VAR_IN_OUT io : INT; END_VAR io := 1; END_FUNCTION_BLOCK"""
    with pytest.raises(LogicError, match="NULL"):
        run("x : INT; r : REF_TO INT; t : REF_TO T1; s : T1; f : fb;", body, before)


def test_a_reference_is_null_until_it_is_assigned() -> None:
    assert run("r : REF_TO INT; q : REF_TO INT := NULL;", ";")["r"] is None


def test_a_structure_may_refer_to_its_own_type() -> None:
    before = "TYPE Node : STRUCT value : INT; next : REF_TO Node; END_STRUCT; END_TYPE"
    found = run(
        "n : ARRAY[1..3] OF Node; at : REF_TO Node; sum, i : INT;",
        """FOR i := 1 TO 3 DO n[i].value := i; IF i < 3 THEN n[i].next := REF(n[i + 1]); END_IF END_FOR
        at := REF(n[1]); WHILE at <> NULL DO sum := sum + at^.value; at := at^.next; END_WHILE""",
        before,
    )
    assert found["sum"] == 6


def test_functions_and_blocks_take_and_return_references() -> None:
    before = """FUNCTION larger : REF_TO INT VAR_INPUT a, b : REF_TO INT; END_VAR
      IF a^ > b^ THEN larger := a; ELSE larger := b; END_IF END_FUNCTION
    FUNCTION_BLOCK adder VAR_INPUT to : REF_TO INT; END_VAR to^ := to^ + 10; END_FUNCTION_BLOCK"""
    found = run(
        "x : INT := 3; y : INT := 4; r : REF_TO INT; f : adder;",
        "r := larger(REF(x), b := REF(y)); r^ := 9; f(to := REF(x));",
        before,
    )
    assert (found["x"], found["y"]) == (13, 9)


def test_a_block_is_called_through_a_reference() -> None:
    before = (
        "FUNCTION_BLOCK counter VAR_INPUT by : INT; END_VAR VAR_OUTPUT n : INT; END_VAR n := n + by; END_FUNCTION_BLOCK"
    )
    found = run(
        "c : counter; r : REF_TO counter; n : INT;", "r := REF(c); r^(by := 4); r^.by := 5; r^(); n := r^.n;", before
    )
    assert found["n"] == 9


def test_a_type_may_be_a_reference_and_a_global_variable_may_have_references() -> None:
    found = run(
        "r : Ref; n : INT;",
        "r := REF(g); r^ := 4; n := g;",
        "TYPE Ref : REF_TO INT; END_TYPE VAR_GLOBAL g : INT; END_VAR",
    )
    assert found["n"] == 4


def test_an_assignment_attempt_gives_null_for_another_type_of_block() -> None:
    before = """FUNCTION_BLOCK a VAR x : INT; END_VAR ; END_FUNCTION_BLOCK
    FUNCTION_BLOCK b VAR x : INT; END_VAR ; END_FUNCTION_BLOCK"""
    found = run(
        "i : a; r, q : REF_TO a; s : REF_TO b; b1, b2 : BOOL;",
        "r := REF(i); q ?= r; b1 := q = r; s ?= r; b2 := s = NULL;",
        before,
    )
    assert (found["b1"], found["b2"]) == (True, True)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("r := x;", "REF_TO INT"),
        ("x := r;", "write \\^"),
        ("r := REF(y);", "the memory of a REAL as a INT is not supported"),
        ("r := REF(5);", "needs a variable"),
        ("r := REF(c);", "needs a variable"),
        ("r := REF(w.3);", "needs a variable"),
        ("r := REF(t);", "exists only during a call"),
        ("r := REF(input);", "can be assigned to"),
        ("r := r + 2;", "operands of \\+"),
        ("b := r < r;", "operands of <"),
        ("x := x^;", "not a reference"),
        ("r := 0;", "REF_TO INT"),
        ("r ?= rr;", "types differ"),
        ("x ?= 3;", "operands of \\?="),
        ("r REF= x;", "left side of REF="),
        ("r := ADR(x);", "the standard has REF"),
        ("x := SIZEOF(x);", "not in the standard"),
    ],
)
def test_a_wrong_use_of_references_is_an_error(body: str, message: str) -> None:
    text = f"""PROGRAM p VAR_INPUT input : INT; END_VAR
    VAR x : INT; y : REAL; w : WORD; b : BOOL; r : REF_TO INT; rr : REF_TO REAL; END_VAR
    VAR CONSTANT c : INT := 1; END_VAR VAR_TEMP t : INT; END_VAR
    {body} END_PROGRAM"""
    with pytest.raises(FileInvalid, match=message):
        program(text)


def test_the_types_of_codesys_are_not_in_the_standard() -> None:
    for word in ("POINTER TO", "REFERENCE TO"):
        with pytest.raises(FileInvalid, match=f"{word} is not in the standard"):
            run(f"r : {word} INT;", ";")


def test_a_reference_in_a_function_to_its_own_variable_is_refused() -> None:
    before = "FUNCTION f : INT VAR x : INT; r : REF_TO INT; END_VAR r := REF(x); f := r^; END_FUNCTION"
    with pytest.raises(FileInvalid, match="exists only during a call"):
        run("x : INT;", "x := f();", before)


def test_a_reference_cannot_be_retained_and_a_retained_structure_keeps_its_other_members() -> None:
    with pytest.raises(FileInvalid, match="cannot be RETAIN"):
        program("PROGRAM p VAR RETAIN r : REF_TO INT; END_VAR ; END_PROGRAM")
    text = """TYPE S : STRUCT n : INT; r : REF_TO INT; END_STRUCT; END_TYPE
    PROGRAM p VAR RETAIN s : S; END_VAR VAR x : INT; END_VAR s.n := s.n + 1; s.r := REF(x); END_PROGRAM"""
    first, second = program(text), program(text)
    scan(first)
    kept = json.loads(json.dumps(first.retained()))
    second.restore(kept)
    scan(second)
    assert (second.st_body.v_s.m_n, second.st_body.v_s.m_r is None) == (2, False)


def test_a_copy_of_a_program_refers_to_its_own_variables_and_has_the_same_state() -> None:
    text = "PROGRAM p VAR a : ARRAY[1..2] OF INT; r : REF_TO INT; END_VAR r := REF(a[2]); r^ := r^ + 1; END_PROGRAM"
    made = program(text)
    scan(made)
    copied = copy.deepcopy(made)
    assert copied.whole_state(0) == made.whole_state(0)
    copied.st_body.v_r.v = 50
    assert (made.st_body.v_a, copied.st_body.v_a) == ([0, 1], [0, 50])


def test_programs_that_refer_to_different_variables_have_different_states() -> None:
    text = """PROGRAM p VAR_INPUT second : BOOL; END_VAR VAR x, y : INT; r : REF_TO INT; END_VAR
    r := REF(x); IF second THEN r := REF(y); END_IF IF r = NULL THEN r^ := 1; END_IF END_PROGRAM"""
    one, other = program(text), program(text)
    other.second = True  # type: ignore[attr-defined]
    scan(one)
    scan(other)
    states = [made.whole_state(0) for made in (one, other)]
    for made in (one, other):
        made.st_body.v_second = False
    assert states[0] != states[1]
    assert one.whole_state(0) != other.whole_state(0), "only the references differ now"


def test_a_reference_is_shown_without_its_place() -> None:
    made = program("PROGRAM p VAR x : INT; r, q : REF_TO INT; END_VAR r := REF(x); END_PROGRAM")
    scan(made)
    shown = {name: made.internal(name) for name in ("r", "q")}
    assert [found.value for found in shown.values() if found is not None] == ["a reference", "NULL"]


def test_an_assignment_attempt_accepts_a_block_that_extends_the_target() -> None:
    before = """FUNCTION_BLOCK a VAR x : INT; END_VAR ; END_FUNCTION_BLOCK
    FUNCTION_BLOCK b EXTENDS a END_FUNCTION_BLOCK
    FUNCTION_BLOCK c EXTENDS b END_FUNCTION_BLOCK"""
    found = run(
        "i : a; k : c; r : REF_TO a; s : REF_TO b; b1, b2 : BOOL;",
        "r := REF(k); s ?= r; b1 := s <> NULL; r := REF(i); s ?= r; b2 := s = NULL;",
        before,
    )
    assert (found["b1"], found["b2"]) == (True, True)
    with pytest.raises(FileInvalid, match="expected REF_TO b; got REF_TO a"):
        run("i : a; s : REF_TO b;", "s := REF(i);", before)
