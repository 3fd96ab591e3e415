"""Sequential function charts in Structured Text (IEC 61131-3:2013, 6.7)."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_charts import random_charts, text_of_chart
from st_bench import program, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.program import Program

# The step On is active in scans 3 to 6 and the step End from scan 7 on; a scan takes 10 ms. A letter or digit for each of the
# scans 1 to 12: "1" while the action's Q is TRUE, and the number of executions of an action with a body.
ACTIVE = range(3, 7)
QUALIFIERS = {
    "N": ("", "001111000000", "001234555555"),
    "S": ("", "001111111100", "001234567899"),
    "L": (", T#20ms", "001100000000", "001233333333"),
    "D": (", T#20ms", "000011000000", "000012333333"),
    "P": ("", "001000000000", "001222222222"),
    "P1": ("", "001000000000", "001111111111"),
    "P0": ("", "000000100000", "000000111111"),
    "SD": (", T#50ms", "000000011100", "000000012344"),
    "DS": (", T#20ms", "000011111100", "000012345677"),
    "SL": (", T#50ms", "001111100000", "001234566666"),
}


def chart(association: str, reset: str) -> str:
    return f"""
PROGRAM p
VAR_INPUT go, leave, stop : BOOL; END_VAR
VAR_OUTPUT q : BOOL; n : INT; END_VAR
INITIAL_STEP Wait: END_STEP
STEP On: {association} END_STEP
STEP Off: END_STEP
STEP Reset: {reset} END_STEP
TRANSITION FROM Wait TO On := go; END_TRANSITION
TRANSITION FROM On TO Off := leave; END_TRANSITION
TRANSITION FROM Off TO Reset := stop; END_TRANSITION
ACTION Count: n := n + 1; END_ACTION
END_PROGRAM
"""


@pytest.mark.parametrize("qualifier", QUALIFIERS)
def test_each_qualifier_follows_the_timing_of_the_standard(qualifier: str) -> None:
    time, outputs, counts = QUALIFIERS[qualifier]
    made = program(chart(f"q({qualifier}{time}); Count({qualifier}{time});", "q(R); Count(R);"))
    seen_q, seen_n = "", ""
    for number in range(1, 13):
        made.go, made.leave, made.stop = number == ACTIVE[0], number == ACTIVE[-1] + 1, number == 11  # type: ignore[attr-defined]
        scan(made, number)
        seen_q += str(int(made.q))  # type: ignore[attr-defined]
        seen_n += str(made.n)  # type: ignore[attr-defined]
    assert (seen_q, seen_n) == (outputs, counts)


def internal(made: Program, path: str) -> object:
    found = made.internal(path)
    assert found is not None, path
    return found.value


def test_a_step_has_its_state_and_the_time_since_its_activation() -> None:
    made = program("""
        PROGRAM p
        VAR_OUTPUT long : BOOL; END_VAR
        INITIAL_STEP A: END_STEP
        STEP B: END_STEP
        TRANSITION FROM A TO B := A.T >= T#20ms; END_TRANSITION
        TRANSITION FROM B TO A := B.X AND B.T >= T#10ms; END_TRANSITION
        END_PROGRAM""")
    seen = []
    for number in range(1, 8):
        scan(made, number)
        seen.append((internal(made, "A.X"), internal(made, "B.X"), internal(made, "A.T")))
    ms = 1_000_000
    assert seen == [
        (True, False, 0), (True, False, 10 * ms), (False, True, 20 * ms), (True, False, 0),
        (True, False, 10 * ms), (False, True, 20 * ms), (True, False, 0),
    ]  # fmt: skip
    assert list(made.internal_names()) == ["A.X", "A.T", "B.X", "B.T"]


BRANCHES = """
FUNCTION_BLOCK Net
VAR_INPUT c : ARRAY[0..4] OF BOOL; END_VAR
INITIAL_STEP Start: END_STEP
STEP Left: END_STEP
STEP Right: END_STEP
STEP Deep: END_STEP
STEP Other: END_STEP
TRANSITION fork FROM Start TO (Left, Right) := c[0]; END_TRANSITION
TRANSITION FROM Start TO Other := c[1]; END_TRANSITION
TRANSITION (PRIORITY := 1) FROM Other TO Other := c[4]; END_TRANSITION
TRANSITION FROM Other TO Start := c[2]; END_TRANSITION
TRANSITION FROM Left TO Deep := c[3]; END_TRANSITION
TRANSITION join FROM (Deep, Right) TO Start := c[4]; END_TRANSITION
END_FUNCTION_BLOCK
PROGRAM p VAR_INPUT a0, a1, a2, a3, a4 : BOOL; END_VAR VAR net : Net; END_VAR
net.c[0] := a0; net.c[1] := a1; net.c[2] := a2; net.c[3] := a3; net.c[4] := a4;
net();
END_PROGRAM
"""
MOVES = [  # in the order of priority: sources, targets, and the number of the condition
    ({"Other"}, {"Other"}, 4), ({"Start"}, {"Left", "Right"}, 0), ({"Start"}, {"Other"}, 1), ({"Other"}, {"Start"}, 2),
    ({"Left"}, {"Deep"}, 3), ({"Deep", "Right"}, {"Start"}, 4),
]  # fmt: skip


@given(st.lists(st.lists(st.booleans(), min_size=5, max_size=5), max_size=25))
def test_branches_activate_the_steps_of_a_reference_interpreter(scans: list[list[bool]]) -> None:
    made = program(BRANCHES)
    active = {"Start"}
    scan(made, 1)
    for number, conditions in enumerate(scans, 2):
        for n, condition in enumerate(conditions):
            setattr(made, f"a{n}", condition)
        scan(made, number)
        left, gained = set(active), set()
        for sources, targets, condition_of in MOVES:
            if sources <= left and conditions[condition_of]:
                left, gained = left - sources, gained | targets
        active = left | gained
        steps = ("Start", "Left", "Right", "Deep", "Other")
        assert {step for step in steps if internal(made, f"net.{step}.X")} == active


@given(random_charts(), st.lists(st.integers(0, 2**20 - 1), max_size=20))
def test_random_safe_charts_activate_the_steps_of_a_reference_interpreter(
    built: tuple[list[str], list[tuple[list[str], list[str]]]], scans: list[int]
) -> None:
    steps, moves = built
    made = program(text_of_chart(steps, moves))
    scan(made, 1)
    active = {"s0"}
    for number, bits in enumerate(scans, 2):
        made.c = bits  # type: ignore[attr-defined]
        scan(made, number)
        left, gained = set(active), set()
        for n, (sources, targets) in enumerate(moves):
            if set(sources) <= left and bits >> n & 1:
                left, gained = left - set(sources), gained | set(targets)
        active = left | gained
        assert {step for step in steps if internal(made, f"{step}.X")} == active


A, B = "INITIAL_STEP A: END_STEP\n", "STEP B: END_STEP\n"


@pytest.mark.parametrize(
    ("body", "line", "message"),
    [
        ("STEP A: END_STEP", 2, "the chart of p has no initial step"),
        (A + "INITIAL_STEP B: END_STEP", 3, "B is a second initial step; the first is A"),
        (A + A.replace("INITIAL_", ""), 3, "step A is declared twice"),
        (A + "TRANSITION FROM A TO C := TRUE; END_TRANSITION", 3, "step 'C' is not declared"),
        (A + B, 3, "step B cannot be reached from the initial step"),
        (
            A + B + "STEP C: END_STEP\nTRANSITION FROM A TO B := x; END_TRANSITION\nTRANSITION FROM A TO C := x; END_TRANSITION\n"
            "TRANSITION FROM (B, C) TO A := x; END_TRANSITION",
            7, "B, C can never be active together",
        ),
        (
            A + B + "STEP C: END_STEP\nTRANSITION FROM A TO (B, C) := x; END_TRANSITION\n"
            "TRANSITION FROM B TO A := x; END_TRANSITION",
            5, "the transition activates C, which can already be active",
        ),
        ("INITIAL_STEP A: x(Q); END_STEP", 2, "the qualifier of action x"),
        ("INITIAL_STEP A: x(L); END_STEP", 2, "action x has no time"),
        ("INITIAL_STEP A: x(N, 5); END_STEP", 2, "the indicator of action x is not a variable"),
        ("INITIAL_STEP A: x(L, T#1s, t); END_STEP", 2, "the indicator of action x; expected BOOL; got TIME"),
        ("INITIAL_STEP A: x(N, y); END_STEP", 2, "'y' is not declared"),
        (A + B + "TRANSITION FROM A TO B: y := x; END_TRANSITION", 4, "a transition with a body needs a name"),
        (A + B + "TRANSITION x FROM A TO B: x := TRUE; END_TRANSITION", 4, "transition x has a name that is used"),
        (A + B + "TRANSITION B FROM A TO B: B := TRUE; END_TRANSITION", 4, "transition B has a name that is used"),
        (A + B + "TRANSITION go FROM A TO B:\nRETURN; END_TRANSITION", 5, "RETURN in the body of a transition"),
        (A + "ACTION go: INITIAL_STEP A: END_STEP END_ACTION", 3, "step A is declared twice"),
        (A + "ACTION go: STEP B: END_STEP END_ACTION", 3, "the chart of p.go has no initial step"),
        (A + "ACTION go: INITIAL_STEP B: END_STEP\nx := TRUE; END_ACTION", 4, "a statement next to steps"),
        (
            A.replace(":", ": x(N);") + "ACTION go: INITIAL_STEP B: x(N); END_STEP END_ACTION", 3,
            "action x belongs to steps of two charts of p",
        ),
        ("INITIAL_STEP A: y(N); END_STEP", 2, "'y' is not declared"),
        (A + "x := TRUE;", 3, "a statement next to steps"),
        ("INITIAL_STEP A: x(L, T#1s);\nx(L, T#2s); END_STEP", 3, "step A has action x twice with the qualifier L"),
        (A + "ACTION go: A(); END_ACTION", 3, "step A cannot be called"),
        (A + "ACTION go: A.X := TRUE; END_ACTION", 3, "A cannot be assigned to"),
        (A + B + "TRANSITION FROM A TO B := 5; END_TRANSITION", 4, "expected BOOL"),
    ],
)  # fmt: skip
def test_an_error_in_a_chart_names_its_line(body: str, line: int, message: str) -> None:
    with pytest.raises(FileInvalid) as caught:
        program(f"PROGRAM p VAR x : BOOL; t : TIME; END_VAR\n{body}\nEND_PROGRAM")
    assert caught.value.line == line
    assert message in str(caught.value)


def test_an_action_may_be_a_global_variable() -> None:
    made = program("""VAR_GLOBAL lamp : BOOL; END_VAR
    PROGRAM p VAR_OUTPUT seen : BOOL; END_VAR
    INITIAL_STEP A: lamp(N); Look(N); END_STEP
    ACTION Look: seen := lamp; END_ACTION
    END_PROGRAM""")
    scan(made, 1)
    scan(made, 2)
    assert made.seen  # type: ignore[attr-defined]


def test_a_function_has_no_chart() -> None:
    with pytest.raises(FileInvalid):
        program("FUNCTION f : INT\nINITIAL_STEP A: END_STEP\nEND_FUNCTION\nPROGRAM p END_PROGRAM")


def test_step_and_transition_remain_ordinary_names() -> None:
    made = program(
        "PROGRAM p VAR_OUTPUT step, transition, n, r : INT; END_VAR step := 2; transition := step + 1; END_PROGRAM"
    )
    scan(made)
    assert made.transition == 3  # type: ignore[attr-defined]


def test_an_indicator_variable_has_no_effect() -> None:
    made = program("""
        PROGRAM p VAR_OUTPUT q, done : BOOL; END_VAR
        INITIAL_STEP A: q(L, T#10ms, done); Look(N, done, q); END_STEP
        ACTION Look: done := NOT q; END_ACTION
        END_PROGRAM""")
    seen = []
    for number in range(1, 4):
        scan(made, number)
        seen.append((made.q, made.done))  # type: ignore[attr-defined]
    assert seen == [(True, False), (False, True), (False, True)]


def test_the_body_of_a_transition_assigns_its_condition_while_its_steps_are_active() -> None:
    made = program("""
        PROGRAM p VAR_INPUT level : INT; END_VAR VAR_OUTPUT n : INT; END_VAR
        INITIAL_STEP A: END_STEP
        STEP B: END_STEP
        TRANSITION full FROM A TO B:
          n := n + 1;
          IF level > 5 THEN full := TRUE; END_IF
        END_TRANSITION
        TRANSITION back FROM B TO A: back := level < 2; END_TRANSITION
        END_PROGRAM""")
    seen = []
    for number, level in enumerate((9, 3, 9, 9, 1, 3, 1), 1):
        made.level = level  # type: ignore[attr-defined]
        scan(made, number)
        seen.append((internal(made, "B.X"), made.n))  # type: ignore[attr-defined]
    assert seen == [(False, 0), (False, 1), (True, 2), (True, 2), (False, 2), (False, 3), (False, 4)]


def test_the_chart_of_an_action_runs_with_its_step_and_keeps_its_own_step() -> None:
    made = program("""
        PROGRAM p VAR_INPUT go : BOOL; END_VAR VAR_OUTPUT red, green : BOOL; END_VAR
        INITIAL_STEP Off: END_STEP
        STEP On: Blink(N); END_STEP
        TRANSITION FROM Off TO On := go; END_TRANSITION
        TRANSITION FROM On TO Off := NOT go; END_TRANSITION
        ACTION Blink:
          INITIAL_STEP Stop: red(N); END_STEP
          STEP Pass: green(N); END_STEP
          TRANSITION FROM Stop TO Pass := TRUE; END_TRANSITION
          TRANSITION FROM Pass TO Stop := TRUE; END_TRANSITION
        END_ACTION
        END_PROGRAM""")
    seen = ""
    for number, go in enumerate((0, 1, 1, 1, 0, 0, 1, 1), 1):
        made.go = bool(go)  # type: ignore[attr-defined]
        scan(made, number)
        seen += "r" if made.red else "g" if made.green else "-"  # type: ignore[attr-defined]
    assert seen == "-rgrggrg"  # the chart runs once more after its control, and continues where it stopped
    assert list(made.internal_names()) == [
        "Off.X", "Off.T", "On.X", "On.T", "Stop.X", "Stop.T", "Pass.X", "Pass.T",
    ]  # fmt: skip


def test_an_action_does_not_execute_its_own_chart() -> None:
    with pytest.raises(FileInvalid, match=r"calls itself|recursi"):
        program("PROGRAM p go(); ACTION go: INITIAL_STEP B: go(N); END_STEP END_ACTION END_PROGRAM")
