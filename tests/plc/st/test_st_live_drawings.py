"""The present values of drawings, read from running programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from st_bench import program, scan

from fieldtwin.plc.program import Program
from fieldtwin.plc.st.compiler.compile import compile_unit
from fieldtwin.plc.st.plcopen.read import read_plcopen
from fieldtwin.plc.st.program import load_source, program_class

PLANT = Path(__file__).parents[2] / "vectors" / "plcopen" / "drawn_networks.xml"
CHART = """
VAR_GLOBAL allowed : BOOL := TRUE; END_VAR
FUNCTION_BLOCK Blinker
VAR_OUTPUT lit : BOOL; END_VAR
INITIAL_STEP Dark: END_STEP
STEP Bright: lit(N); END_STEP
TRANSITION FROM Dark TO Bright := TRUE; END_TRANSITION
TRANSITION FROM Bright TO Dark := TRUE; END_TRANSITION
END_FUNCTION_BLOCK
FUNCTION Known : BOOL VAR_INPUT x : BOOL; END_VAR Known := x; END_FUNCTION
PROGRAM Main
VAR_INPUT go : BOOL; END_VAR
VAR_OUTPUT run : BOOL; END_VAR
VAR lamps : ARRAY[1..2] OF INT; left : Blinker; END_VAR
INITIAL_STEP Idle: END_STEP
STEP On: run(D, T#20ms); Blink(N); END_STEP
TRANSITION FROM Idle TO On := go AND lamps[1] = 0 AND allowed; END_TRANSITION
TRANSITION FROM On TO Idle := NOT Known(go); END_TRANSITION
ACTION Blink: left(); END_ACTION
END_PROGRAM
"""


def test_a_chart_has_active_steps_times_conditions_and_actions() -> None:
    made = program(CHART, "Main")
    assert [name for name, _ in made.drawings()] == ["Main", "Main.left"]
    scan(made, 1)
    assert made.drawn(0) == {
        "steps": {"Idle": {"active": True, "time_s": 0.0}, "On": {"active": False, "time_s": 0.0}},
        "transitions": {"0": {"enabled": True, "true": False}, "1": {"enabled": False, "true": None}},
        "actions": {"run": False, "Blink": False},
    }
    made.go = True  # type: ignore[attr-defined]
    seen = []
    for number in range(2, 6):
        scan(made, number)
        values = made.drawn(0)
        seen.append((values["steps"]["On"], values["actions"]))
        assert values["transitions"]["0"] == {"enabled": False, "true": True}
    assert seen[0] == ({"active": True, "time_s": 0.0}, {"run": False, "Blink": True})
    assert seen[2] == ({"active": True, "time_s": 0.02}, {"run": True, "Blink": True})
    made.go = False  # type: ignore[attr-defined]
    scan(made, 6)  # the action is executed a last time, and its control is FALSE
    assert made.drawn(0)["actions"] == {"run": False, "Blink": False}
    assert made.drawn(1)["steps"]["Bright"]["active"] is not made.drawn(1)["steps"]["Dark"]["active"]


def test_reading_the_values_does_not_change_the_program() -> None:
    read, unread = program(CHART, "Main"), program(CHART, "Main")
    for number in range(1, 9):
        for made in (read, unread):
            made.go = number % 3 > 0  # type: ignore[attr-defined]
            scan(made, number)
        read.drawn(0)
        read.drawn(1)
        now_ns = number * 10_000_000
        assert read.whole_state(now_ns) == unread.whole_state(now_ns)


def test_a_ladder_has_the_states_of_contacts_coils_and_outputs() -> None:
    made: Any = load_source(PLANT, "Motor")()
    for number in range(1, 3):
        scan(made, number)
    values = made.drawn(0)
    assert values["nodes"] == {"2": False, "3": False, "4": False, "5": False, "6": False, "8": True, "10": False}
    assert values["wires"]["1."] is True
    assert values["wires"]["7.ET"] == 10_000_000
    made.put("start_button", True)
    made.put("release", False)
    scan(made, 3)
    assert made.drawn(0)["nodes"]["2"] is made.drawn(0)["nodes"]["4"] is True
    tank: Any = load_source(PLANT, "Tank")()
    tank.put("level", 5.0)
    scan(tank, 1)
    assert tank.drawn(0)["wires"]["3.OUT"] is True  # GT of level and the limit 0
    assert tank.drawn(0)["wires"]["5.OUT"] is True
    tank.put("enable", True)
    scan(tank, 2)
    assert tank.drawn(0)["wires"]["5.OUT"] is False  # through the negated input
    text = PLANT.read_text().replace(
        '<variable formalParameter="OUT">', '<variable formalParameter="OUT" negated="true">', 1
    )
    negated: Any = program_class(compile_unit(read_plcopen(text, "p.xml"), "p.xml", ("p.xml",)), "Tank")()
    scan(negated, 1)
    assert negated.drawn(0)["wires"]["3.OUT"] is True  # GT is FALSE, and its output is negated


EXPRESSIONS = st.recursive(
    st.sampled_from(["a", "b", "TRUE", "FALSE", "(n > 3)", "(n = m)", "(n + m < 7)", "(n <> 2)", "w.1"]),
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from(["AND", "OR", "XOR", "=", "<>"]), inner).map(
            lambda x: f"({x[0]} {x[1]} {x[2]})"
        ),
        inner.map(lambda x: f"NOT ({x})"),
    ),
    max_leaves=6,
)


@given(EXPRESSIONS, st.booleans(), st.booleans(), st.integers(-5, 5), st.integers(-5, 5))
def test_a_condition_has_the_value_that_the_program_computes(text: str, a: bool, b: bool, n: int, m: int) -> None:
    made: Any = program(
        f"""PROGRAM p VAR_INPUT a, b : BOOL; n, m : INT; w : BYTE; END_VAR VAR_OUTPUT q : BOOL; END_VAR
        INITIAL_STEP S1: Compute(N); END_STEP
        STEP S2: END_STEP
        TRANSITION FROM S1 TO S2 := FALSE AND ({text}); END_TRANSITION
        TRANSITION FROM S1 TO S2 := {text}; END_TRANSITION
        ACTION Compute: q := {text}; END_ACTION
        END_PROGRAM"""
    )
    made.a, made.b, made.n, made.m, made.w = a, b, n, m, 2
    scan(made, 1)
    shown = made.drawn(0)["transitions"]["1"]["true"]
    assert shown is made.q or (shown is None and "w.1" in text)


def test_the_states_of_a_case_have_their_transitions_in_the_description() -> None:
    made: Program = program(
        """TYPE Mode : (Idle, Run); END_TYPE
        PROGRAM p VAR_INPUT go : BOOL; END_VAR VAR state : Mode; END_VAR
        CASE state OF Idle: IF go THEN state := Run; END_IF Run: IF NOT go THEN state := Idle; END_IF END_CASE
        END_PROGRAM"""
    )
    found = made.state_diagram()
    assert [(one.source, one.target, one.label) for one in found.transitions] == [
        ("Idle", "Run", "go"), ("Run", "Idle", "NOT go"),
    ]  # fmt: skip
    assert program("PROGRAM p END_PROGRAM").state_diagram() is None


@pytest.mark.parametrize("pou", ["Motor", "Tank"])
def test_every_drawn_part_has_a_value_or_none(pou: str) -> None:
    unit = compile_unit(read_plcopen(PLANT.read_text(), str(PLANT)), str(PLANT), (str(PLANT),))
    made = program_class(unit, pou)()
    scan(made, 1)
    (drawing,) = made.drawings()
    values = made.drawn(0)
    for node in values["nodes"]:
        assert f'data-node="{node}"' in drawing[1]
