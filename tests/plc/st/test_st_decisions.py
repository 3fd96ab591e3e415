"""The statement that gave a variable its value, and what decided that it was executed."""

from __future__ import annotations

import copy
from typing import Any

from st_bench import program, scan

from fieldtwin.plc.st.decisions.reading import Decided
from fieldtwin.plc.st.decisions.statements import decisions_of
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


def decision_of(made: StProgram, name: str) -> Decided | None:
    return made.last_assignment(name)[1]


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


STARTERS = """FUNCTION_BLOCK Starter
VAR_INPUT start : BOOL; END_VAR
VAR_OUTPUT run : BOOL; END_VAR
VAR delay : TON; END_VAR
  delay(IN := start, PT := T#2s);
  IF delay.Q THEN
    run := TRUE;
  ELSE
    run := FALSE;
  END_IF
END_FUNCTION_BLOCK
FUNCTION_BLOCK Pump
VAR_INPUT on : BOOL; END_VAR
VAR_OUTPUT motor : BOOL; END_VAR
VAR starter : Starter; locked : BOOL; END_VAR
  starter(start := on);
  motor := starter.run AND NOT locked;
END_FUNCTION_BLOCK
PROGRAM p
VAR_INPUT wanted : BOOL; END_VAR
VAR_OUTPUT a, b : BOOL; END_VAR
VAR pump : Pump; END_VAR
  pump(on := wanted, motor => a);
  b := pump.motor;
END_PROGRAM
"""


def inside(name: str) -> list[dict[str, Any]]:
    made = program(STARTERS)
    made.wanted = True
    scan(made, 1, ms=0)
    scan(made, 2, ms=2000)
    found = decision_of(made, name)
    assert found is not None
    return list(found.describe()["inside"])


def test_the_statements_inside_nested_blocks_are_named_with_their_locals() -> None:
    for name in ("a", "b"):
        pump, starter = inside(name)
        assert (pump["instance"], pump["block"], pump["statement"]) == (
            "pump",
            "Pump",
            "motor := starter.run AND NOT locked",
        )
        assert pump["place"].endswith(":17")
        assert pump["variables"] == {"starter.run": "TRUE", "locked": "FALSE"}
        assert starter == {
            "instance": "pump.starter",
            "block": "Starter",
            "place": starter["place"],
            "statement": "run := TRUE",
            "conditions": [{"line": 6, "text": "delay.Q", "holds": True}],
            "variables": {"delay.Q": "TRUE"},
        }
        assert starter["place"].endswith(":7")


def test_a_method_that_assigned_the_output_is_named() -> None:
    made = program(
        """FUNCTION_BLOCK Valve
        VAR_OUTPUT open : BOOL; END_VAR
        METHOD PUBLIC Set
        VAR_INPUT x : INT; END_VAR
          open := x > 3;
        END_METHOD
        END_FUNCTION_BLOCK
        PROGRAM p
        VAR_OUTPUT q : BOOL; END_VAR
        VAR valve : Valve; END_VAR
          valve.Set(x := 5);
          q := valve.open;
        END_PROGRAM"""
    )
    scan(made)
    found = decision_of(made, "q")
    assert found is not None
    (valve,) = found.describe()["inside"]
    assert (valve["statement"], valve["place"].rpartition(":")[2]) == ("open := x > 3", "5")


def test_two_instances_of_a_block_have_different_lines() -> None:
    made = program(
        STARTERS.partition("PROGRAM")[0]
        + """PROGRAM p
        VAR_OUTPUT q, r : BOOL; END_VAR
        VAR one, two : Starter; END_VAR
          one(start := TRUE); two();
          q := one.run; r := NOT two.run;
        END_PROGRAM"""
    )
    scan(made, 1, ms=0)
    scan(made, 2, ms=3000)
    found = [decision_of(made, name) for name in ("q", "r")]
    lines = [one.describe()["inside"][0]["place"].rpartition(":")[2] for one in found if one is not None]
    assert lines == ["7", "9"]


def test_the_lines_of_a_block_are_no_part_of_its_state() -> None:
    one, other = program(STARTERS), program(f"\n\n{STARTERS}")  # with different lines
    for made in (one, other):
        made.wanted = False
        scan(made, 1, ms=0)
    assert one.whole_state(0) == other.whole_state(0)
    assert copy.deepcopy(one).whole_state(0) == one.whole_state(0)


def test_statements_inside_blocks_are_limited() -> None:
    block = (
        "FUNCTION_BLOCK B{} VAR_OUTPUT q : BOOL; END_VAR VAR b : B{}; END_VAR\n b(); q := b.q;\nEND_FUNCTION_BLOCK\n"
    )
    blocks = "".join(block.format(n, n - 1) for n in range(1, 20))
    made = program(
        "FUNCTION_BLOCK B0 VAR_OUTPUT q : BOOL; END_VAR q := TRUE; END_FUNCTION_BLOCK\n"
        + blocks
        + "PROGRAM p VAR_OUTPUT q : BOOL; END_VAR VAR b : B19; END_VAR\n b();\n q := b.q;\nEND_PROGRAM"
    )
    scan(made)
    found = decision_of(made, "q")
    assert found is not None
    assert len(found.describe()["inside"]) == 8


def test_decisions_are_made_when_they_are_looked_up() -> None:
    unit = program(PUMP).st_unit.source
    found = decisions_of(unit)
    assert "_found" not in vars(found)
    assert {name for _, _, name in found} == {"state", "q", "valve"}


POINTERS = """FUNCTION_BLOCK Holder VAR_OUTPUT x : INT; END_VAR VAR p : POINTER TO INT; END_VAR
  IF FIRST_SCAN() THEN
    x := 1;
  ELSE
    p := ADR(x);
    p^ := 5;
  END_IF
END_FUNCTION_BLOCK
PROGRAM p
VAR_OUTPUT q, r : INT; END_VAR
VAR at : POINTER TO INT; holder : Holder; END_VAR
  holder();
  r := holder.x;
  IF FIRST_SCAN() THEN
    q := 1;
  ELSE
    at := ADR(q);
    at^ := 5;
  END_IF
END_PROGRAM
"""


def test_an_output_that_a_pointer_assigned_has_the_line_of_the_statement_with_the_pointer() -> None:
    made = program(POINTERS, dialect="codesys")
    scan(made, 1)
    place, found = made.last_assignment("q")[0], decision_of(made, "r")
    assert place is not None
    assert place.line == 15
    assert found is not None
    assert len(found.inside) == 1
    scan(made, 2)
    found = decision_of(made, "r")
    assert found is not None
    assert [(one["place"], one["statement"]) for one in found.describe()["inside"]] == [("test.st:6", "p^ := 5")]
    place, found = made.last_assignment("q")[0], decision_of(made, "q")
    assert (place and place.line, found and found.decision.text) == (18, "at^ := 5")


def test_an_output_that_an_inherited_body_assigned_has_the_line_of_the_base() -> None:
    made = program(
        """FUNCTION_BLOCK Base
        VAR_OUTPUT x : INT; END_VAR
          x := x + 1;
        END_FUNCTION_BLOCK
        FUNCTION_BLOCK Derived EXTENDS Base
        VAR_OUTPUT y : INT; END_VAR
          SUPER^();
          y := 2 * x;
        END_FUNCTION_BLOCK
        PROGRAM p
        VAR_OUTPUT q : INT; END_VAR
        VAR d : Derived; END_VAR
          d();
          q := d.x + d.y;
        END_PROGRAM""",
        dialect="codesys",
    )
    scan(made)
    found = decision_of(made, "q")
    assert found is not None
    statements = [one["statement"] for one in found.describe()["inside"]]
    assert statements == ["x := x + 1", "y := 2 * x"]
