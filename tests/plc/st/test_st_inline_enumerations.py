"""Enumerations in the declarations of variables (IEC 61131-3:2013, 6.4.4.2 and table 11, feature 1b)."""

from __future__ import annotations

import pytest
from st_bench import program, run, scan

from fieldtwin.gateway.core.errors import FileInvalid


def test_a_variable_has_the_first_value_or_its_initial_value() -> None:
    found = run(
        "a : (red, green, blue); b : (low := 3, high) := high; c, d : (on, off) := off;",
        "IF c = d THEN d := on; END_IF",
    )
    assert (found["a"], found["b"], found["c"], found["d"]) == (0, 4, 1, 0)


def test_a_sequence_with_a_case_over_its_states() -> None:
    text = """PROGRAM p VAR state : (idle, fill, drain); END_VAR
    CASE state OF idle: state := fill; fill, drain: state := drain; END_CASE END_PROGRAM"""
    made = program(text)
    scan(made, 1)
    first = made.st_body.v_state
    scan(made, 2)
    assert (first, made.st_body.v_state) == (1, 2)


def test_two_pous_may_use_one_name_for_different_values() -> None:
    before = """TYPE Mode : (stop, idle); END_TYPE
    FUNCTION_BLOCK fb VAR_INPUT go : BOOL; END_VAR VAR_OUTPUT s : (idle, run); END_VAR IF go THEN s := run; ELSE s := idle; END_IF
    END_FUNCTION_BLOCK"""
    found = run("f : fb; m : Mode; t : (run, idle, ready);", "f(go := TRUE); m := Mode#idle; t := idle;", before)
    assert (found["f"].v_s, found["m"], found["t"]) == (1, 1, 1)


@pytest.mark.parametrize("dialect", ["standard", "codesys"])
def test_the_type_that_a_value_must_have_decides_which_enumeration_is_meant(dialect: str) -> None:
    """In `codesys`, which converts enumerations, the number of the local enumeration was assigned."""
    before = """TYPE Lamp : (off, amber, green); END_TYPE
    FUNCTION f : INT VAR_INPUT l : Lamp; END_VAR f := SEL(l = Lamp#green, 1, 2); END_FUNCTION"""
    variables = "local : (green, red); l : Lamp := green; m : Lamp; a : (up, down); b : (down, up) := up; n : INT;"
    found = run(variables, "m := green; local := green; a := down; b := down; n := f(green);", before, dialect=dialect)
    assert [found[name] for name in ("l", "m", "local", "a", "b", "n")] == [2, 2, 0, 1, 0, 2]


SHARED = "TYPE A : (X, Y); B : (W, X, Z); END_TYPE"


@pytest.mark.parametrize(
    "body",
    [
        "IF b = X THEN d := 1; END_IF",
        "IF X = b THEN d := 1; END_IF",
        "IF GE(b, X) AND LE(X, b) THEN d := 1; END_IF",
        "CASE b OF W: d := 5; X: d := 1; END_CASE",
        "d := SEL(a = Y, 0, 1); IF b <> X THEN d := 9; END_IF",
    ],
)
def test_a_value_of_several_enumerations_has_the_type_of_the_other_operand_in_the_dialects_of_codesys(
    body: str,
) -> None:
    """In an example of the standard, the comparison with such a name is an error (6.4.4.2)."""
    variables = "a : A := Y; b : B := X; d : DINT;"
    for dialect in ("codesys", "twincat"):
        assert run(variables, body, SHARED, dialect=dialect)["d"] == 1
    with pytest.raises(FileInvalid, match="X is a value of several types; expected A#X, B#X"):
        run(variables, body, SHARED)


def test_a_value_is_known_to_callers_where_a_parameter_demands_it() -> None:
    before = """FUNCTION_BLOCK fb VAR_INPUT s : (idle, run); END_VAR VAR_OUTPUT on : BOOL; END_VAR
    on := s = run; END_FUNCTION_BLOCK"""
    found = run("f : fb; n : BOOL;", "f(s := run, on => n); f.s := idle;", before)
    assert (found["n"], found["f"].v_s) == (True, 0)


def test_members_and_global_variables_may_have_such_types() -> None:
    before = "TYPE S : STRUCT m : (off, on) := on; END_STRUCT; END_TYPE VAR_GLOBAL g : (near, far) := far; END_VAR"
    found = run("s : S; a, b : BOOL; i : (x, y) USINT;", "a := s.m = on; b := g = far; s.m := off;", before)
    assert (found["a"], found["b"], found["s"].m_m) == (True, True, 0)


def test_an_output_is_bound_with_the_names_of_its_values() -> None:
    made = program("PROGRAM p VAR_OUTPUT s : (idle, run) := run; END_VAR ; END_PROGRAM")
    scan(made)
    assert made.s == 1  # type: ignore[attr-defined]
    declared = next(v for v in made.variables.values() if v.name == "s")
    assert declared.words == ((0, "idle"), (1, "run"))


@pytest.mark.parametrize(
    ("variables", "body", "message"),
    [
        ("a : (x, y); b : (y, z); c : BOOL;", "c := a = y;", "y is a value of \\(x, y\\) and of \\(y, z\\)"),
        ("a : (x, y); x : INT;", ";", "x is declared twice"),
        ("a : (x, X);", ";", "has the value X twice"),
        ("a : (x, y) := z;", ";", "'z' is not declared"),
        ("a : (x, y);", "a := 1;", "\\(x, y\\)"),
        ("a : (x, y);", "x := a;", "x cannot be assigned to"),
        ("a : (x := 300, y) USINT;", ";", "outside USINT"),
    ],
)
def test_a_wrong_enumeration_is_an_error(variables: str, body: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        run(variables, body)


def test_a_value_is_not_known_in_other_pous() -> None:
    with pytest.raises(FileInvalid, match="'run' is not declared"):
        run("b : BOOL;", "b := run = run;", "FUNCTION f : INT VAR s : (idle, run); END_VAR f := 1; END_FUNCTION")
