"""The variables to which the pointers and references of a statement pointed when it was executed."""

from __future__ import annotations

import copy
from typing import Any

from st_bench import program, scan

from fieldtwin.plc.st.program import StProgram


def why(made: StProgram, name: str) -> dict[str, Any]:
    found = made.last_assignment(name)[1]
    assert found is not None
    return found.describe()


def shown(one: dict[str, Any]) -> tuple[Any, ...]:
    """Return the variable, the line and the text of a statement."""
    return one["instance"], int(one["place"].rpartition(":")[2]), one["statement"]


TEXT = """TYPE Tank : STRUCT level : INT; Marks : ARRAY[1..2] OF INT; END_STRUCT END_TYPE
VAR_GLOBAL total : INT; at_total : POINTER TO INT; END_VAR
FUNCTION_BLOCK Filler
VAR_INPUT at : POINTER TO INT; END_VAR
VAR_OUTPUT high : BOOL; END_VAR
  high := at^ > 3;
END_FUNCTION_BLOCK
PROGRAM p
VAR
  x : INT; levels : ARRAY[3..5] OF INT; tanks : ARRAY[1..2] OF Tank; i : INT := 2;
  to_x, at : POINTER TO INT; tank : POINTER TO Tank; all : POINTER TO ARRAY[3..5] OF INT; same : REFERENCE TO Tank;
  filler : Filler;
END_VAR
VAR_OUTPUT q, r, s, t, u, v, w : BOOL; END_VAR
  x := 7;
  levels[4] := 8;
  tanks[2].level := 9;
  tanks[2].Marks[1] := 10;
  total := 11;
  to_x := ADR(x);
  q := to_x^ > 5;
  at := ADR(levels[4]);
  IF at^ > 5 THEN
    r := TRUE;
  END_IF
  at := ADR(x);
  tank := ADR(tanks[i]);
  s := tank^.level > 5 AND tank^.Marks[1] > 5;
  all := ADR(levels);
  t := all^[i + 2] > 5;
  at_total := ADR(total);
  u := at_total^ > 5;
  same REF= tanks[2];
  v := same.level > 5;
  filler(at := ADR(tanks[2].level));
  w := filler.high;
END_PROGRAM
"""


def scanned() -> StProgram:
    made = program(TEXT, dialect="twincat")
    scan(made)
    return made


def test_the_variable_to_which_a_pointer_pointed_is_named_with_its_value_and_statement() -> None:
    found = why(scanned(), "q")
    assert (found["variables"], found["pointed"]) == ({"to_x^": "7"}, {"to_x": "x"})


def test_a_pointer_that_was_moved_after_the_statement_has_its_variable_of_then() -> None:
    found = why(scanned(), "r")
    assert found["conditions"] == [{"line": 23, "text": "at^ > 5", "holds": True}]
    assert (found["variables"], found["pointed"]) == ({"at^": "8"}, {"at": "levels[4]"})
    assert [shown(one) for one in found["inside"]] == [("levels[4]", 16, "levels[4] := 8")]


def test_members_and_elements_behind_a_pointer_are_followed() -> None:
    made = scanned()
    found = why(made, "s")
    assert found["variables"] == {"tank^.level": "9", "tank^.Marks[1]": "10"}
    assert found["pointed"] == {"tank": "tanks[2]"}
    assert [shown(one)[1:] for one in found["inside"]] == [
        (17, "tanks[2].level := 9"),
        (18, "tanks[2].Marks[1] := 10"),
    ]
    found = why(made, "t")
    assert (found["variables"], found["pointed"]) == ({"all^[4]": "8"}, {"all": "levels"})
    assert [shown(one)[1:] for one in found["inside"]] == [(16, "levels[4] := 8")]


def test_a_global_pointer_and_a_reference_without_a_mark_are_followed() -> None:
    made = scanned()
    found = why(made, "u")
    assert (found["variables"], found["pointed"]) == ({"at_total^": "11"}, {"at_total": "total"})
    assert [shown(one) for one in found["inside"]] == [("total", 19, "total := 11")]
    found = why(made, "v")
    assert (found["variables"], found["pointed"]) == ({"same.level": "9"}, {"same": "tanks[2]"})


def test_a_pointer_that_an_instance_received_names_the_variable_of_the_program() -> None:
    (filler, level) = why(scanned(), "w")["inside"]
    assert shown(filler) == ("filler", 6, "high := at^ > 3")
    assert (filler["variables"], filler["pointed"]) == ({"at^": "9"}, {"at": "tanks[2].level"})
    assert shown(level) == ("tanks[2].level", 17, "tanks[2].level := 9")


def test_a_copy_of_the_program_names_its_own_variables() -> None:
    copied = copy.deepcopy(scanned())
    assert why(copied, "q")["pointed"] == {"to_x": "x"}
    scan(copied, 2)
    assert why(copied, "r")["pointed"] == {"at": "levels[4]"}


def test_a_pointer_that_is_null_or_not_recorded_is_named_with_the_reason() -> None:
    made = program(
        """PROGRAM p
VAR x : INT := 5; at : POINTER TO INT; some : ARRAY[1..2] OF POINTER TO INT; END_VAR
VAR_OUTPUT q, r : BOOL; END_VAR
  q := at = 0 OR_ELSE at^ > 3;
  some[1] := ADR(x);
  r := some[1]^ > 3;
END_PROGRAM""",
        dialect="codesys",
    )
    scan(made)
    assert why(made, "q")["notes"] == ["at^: a pointer that refers to no variable"]
    assert why(made, "r")["notes"] == ["some[1]^: the variable to which some[1] pointed in this line was not recorded"]
