"""Inputs with R_EDGE and F_EDGE."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from st_bench import program, scan

from fieldtwin.gateway.core.errors import FileInvalid

PROGRAM = """
PROGRAM p
VAR_INPUT up : BOOL R_EDGE; down : BOOL F_EDGE := FALSE; END_VAR
VAR_OUTPUT ups, downs : INT; END_VAR
IF UP THEN ups := ups + 1; END_IF
Count();
ACTION Count: IF down AND NOT (up AND FALSE) THEN downs := downs + 1; END_IF END_ACTION
END_PROGRAM
"""


@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=20))
def test_the_input_of_a_program_is_true_at_each_edge_and_only_there(scans: list[tuple[bool, bool]]) -> None:
    made = program(PROGRAM)
    scan(made)  # F_TRIG gives TRUE in the first scan of a FALSE input, by the standard's definition
    ups, downs, before = 0, made.downs, (False, False)  # type: ignore[attr-defined]
    for number, (up, down) in enumerate(scans, 2):
        made.up, made.down = up, down  # type: ignore[attr-defined]
        scan(made, number)
        ups += up and not before[0]
        downs += before[1] and not down
        before = up, down
    assert (made.ups, made.downs) == (ups, downs)  # type: ignore[attr-defined]


def test_each_instance_of_a_function_block_detects_the_edges_of_its_calls() -> None:
    made = program("""
        FUNCTION_BLOCK Counter
        VAR_INPUT CU : BOOL R_EDGE; END_VAR VAR_OUTPUT CV : INT; END_VAR
        IF CU THEN CV := CV + 1; END_IF
        END_FUNCTION_BLOCK
        PROGRAM p
        VAR_INPUT a, b : BOOL; END_VAR VAR one, two : Counter; END_VAR VAR_OUTPUT n, m, raw : INT; END_VAR
        one(CU := a); two(CU := b); two();
        n := one.CV; m := two.CV;
        END_PROGRAM""")
    for number, (a, b) in enumerate([(True, False), (True, True), (False, True), (True, False), (True, True)], 1):
        made.a, made.b = a, b  # type: ignore[attr-defined]
        scan(made, number)
    assert (made.n, made.m) == (2, 2)  # type: ignore[attr-defined]


def test_a_chart_may_use_the_edge_of_an_input() -> None:
    made = program("""
        PROGRAM p VAR_INPUT go : BOOL R_EDGE; END_VAR VAR_OUTPUT n : INT; END_VAR
        INITIAL_STEP A: END_STEP
        STEP B: Count(P1); END_STEP
        TRANSITION FROM A TO B := go; END_TRANSITION
        TRANSITION FROM B TO A := TRUE; END_TRANSITION
        ACTION Count: n := n + 1; END_ACTION
        END_PROGRAM""")
    for number, go in enumerate([False, True, True, True, True, False, True], 1):
        made.go = go  # type: ignore[attr-defined]
        scan(made, number)
    assert made.n == 2  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("text", "got"),
    [
        ("PROGRAM p VAR_INPUT\n a : INT R_EDGE; END_VAR END_PROGRAM", "another type"),
        ("PROGRAM p VAR_OUTPUT\n a : BOOL F_EDGE; END_VAR END_PROGRAM", "VAR_OUTPUT"),
        (
            "FUNCTION f : INT VAR_INPUT\n a : BOOL R_EDGE; END_VAR f := 1; END_FUNCTION PROGRAM p END_PROGRAM",
            "a FUNCTION",
        ),
        ("VAR_GLOBAL\n a : BOOL R_EDGE; END_VAR PROGRAM p END_PROGRAM", "VAR_GLOBAL"),
    ],
)
def test_an_edge_in_a_wrong_place_is_refused(text: str, got: str) -> None:
    with pytest.raises(FileInvalid, match=f"_EDGE of a; expected a BOOL in VAR_INPUT .*got {got}") as caught:
        program(text)
    assert (caught.value.line, caught.value.column) == (2, 2)


def test_an_input_with_an_edge_cannot_be_assigned() -> None:
    with pytest.raises(FileInvalid, match="a cannot be assigned to"):
        program("PROGRAM p VAR_INPUT a : BOOL R_EDGE; END_VAR a := TRUE; END_PROGRAM")
