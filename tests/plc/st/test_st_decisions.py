"""The statement that gave a variable its value, and what decided that it was executed."""

from __future__ import annotations

from typing import Any

from st_bench import program, scan

from fieldtwin.plc.program import Described
from fieldtwin.plc.st.program import StProgram

PUMP = """TYPE States : (IDLE, FILLING, FULL, FAULT); END_TYPE
PROGRAM p
VAR_INPUT level : REAL; END_VAR
VAR_OUTPUT valve : BOOL; q : INT; END_VAR
VAR state : States := FILLING; timer : TON; text : STRING; END_VAR
  timer(IN := state = FILLING, PT := T#30s);
  CASE state OF
    IDLE, FAULT:
      ;
    FILLING:
      IF level >= 80.0 THEN
        state := FULL;
      ELSIF timer.Q THEN
        state := FAULT;
      END_IF
  ELSE
    q := 7;
  END_CASE
  valve := state = FILLING;
END_PROGRAM
"""


def decision_of(made: StProgram, name: str) -> Described | None:
    place = made.place(name)
    return made.decided(name, place) if place is not None else None


def decided(level: float, t_s: int, name: str) -> dict[str, Any] | None:
    made = program(PUMP)
    made.level = 0.0
    scan(made, 1, ms=0)
    made.level = level
    scan(made, 2, ms=1000 * t_s)
    found = decision_of(made, name)
    return found.describe() if found is not None else None


def test_the_conditions_around_the_statement_are_shown_with_the_values_after_the_scan() -> None:
    assert decided(0.0, 30, "state") == {
        "statement": "state := FAULT",
        "conditions": [
            {"line": 10, "text": "state = FILLING", "holds": True},
            {"line": 11, "text": "level >= 80.0", "holds": False},
            {"line": 13, "text": "timer.Q", "holds": True},
        ],
        "variables": {"state": "FAULT", "timer.Q": "TRUE"},
    }


def test_the_first_branch_that_held_decided() -> None:
    found = decided(90.0, 30, "state")
    assert found is not None
    assert found["statement"] == "state := FULL"
    assert [(one["text"], one["holds"]) for one in found["conditions"]] == [
        ("state = FILLING", True),
        ("level >= 80.0", True),
    ]


def test_else_of_a_case_is_decided_by_all_labels() -> None:
    made = program(PUMP)
    made.level = 90.0
    scan(made, 1)
    scan(made, 2)
    found = decision_of(made, "q")
    assert found is not None
    assert found.describe()["conditions"] == [{"line": 7, "text": "state = IDLE, FAULT, FILLING", "holds": False}]


def test_a_variable_with_its_initial_value_or_a_set_one_has_no_decision() -> None:
    assert decided(0.0, 1, "state") is None
    made = program(PUMP)
    made.level = 90.0
    scan(made)
    made.put("state", 3)
    assert decision_of(made, "state") is None


def test_an_output_of_a_block_is_assigned_by_its_call() -> None:
    made = program(
        """PROGRAM p VAR_OUTPUT done : BOOL; END_VAR VAR timer : TON; run : BOOL := TRUE; END_VAR
        IF run THEN
          timer(IN := TRUE, PT := T#1s500ms, Q => done);
        END_IF
        END_PROGRAM"""
    )
    scan(made)
    found = decision_of(made, "done")
    assert found is not None
    assert found.describe() == {
        "statement": "timer(IN := TRUE, PT := T#1s500ms, Q => done)",
        "conditions": [{"line": 2, "text": "run", "holds": True}],
        "variables": {"run": "TRUE"},
    }


def test_values_are_written_as_in_the_source() -> None:
    made = program(
        """PROGRAM p VAR_OUTPUT q : BOOL; END_VAR VAR timer : TON; x : LREAL := 0.1; s : STRING := 'on'; END_VAR
        timer(IN := TRUE, PT := T#5s);
        q := timer.ET < T#2s AND x < 1.0 AND s = 'on';
        END_PROGRAM"""
    )
    scan(made, 1, ms=0)
    scan(made, 2, ms=1500)
    found = decision_of(made, "q")
    assert found is not None
    assert found.describe()["variables"] == {"timer.ET": "T#1s500ms", "x": "0.1", "s": "'on'"}
