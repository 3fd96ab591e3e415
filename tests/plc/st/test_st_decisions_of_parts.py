"""The statements that assigned elements of arrays, members of structures and variables of a VAR_IN_OUT, in which scan, and with
which values of indices.
"""

from __future__ import annotations

import copy
from typing import Any

from st_bench import program, scan

from fieldtwin.plc.st.program import StProgram


def why(made: StProgram, name: str) -> dict[str, Any]:
    place, found = made.last_assignment(name)
    assert place is not None
    assert found is not None
    return found.describe()


def shown(one: dict[str, Any]) -> tuple[Any, ...]:
    """Return the variable, the line, the scan and the text of a statement."""
    return one["instance"], int(one["place"].rpartition(":")[2]), one.get("scan", 0), one["statement"]


SCANNED = """PROGRAM p
VAR_INPUT raw : INT; END_VAR
VAR_OUTPUT alarm : BOOL; q : INT; END_VAR
VAR i, n : INT; levels : ARRAY[1..4] OF INT; grid : ARRAY[0..1, 1..2] OF INT; END_VAR
  n := n MOD 4 + 1;
  levels[n] := raw;
  grid[1, n MOD 2 + 1] := levels[n] * 10;
  FOR i := 1 TO 4 DO
    IF levels[i] > 80 THEN
      alarm := TRUE;
    END_IF
  END_FOR
  q := grid[1, 2];
END_PROGRAM
"""


def test_the_element_that_decided_is_named_with_the_index_and_the_scan_of_its_assignment() -> None:
    made = program(SCANNED)
    for number, raw in enumerate((5, 90, 7), 1):
        made.raw = raw
        scan(made, number)
    found = why(made, "alarm")
    assert found["conditions"] == [{"line": 9, "text": "levels[i] > 80", "holds": True}]
    assert (found["variables"], found["indices"]) == ({"levels[2]": "90"}, {"i": "2"})
    (levels,) = found["inside"]
    assert shown(levels) == ("levels[2]", 6, 2, "levels[n] := raw")
    assert levels["indices"] == {"n": "2"}


def test_an_element_of_two_dimensions_is_followed_to_the_element_from_which_it_was_computed() -> None:
    made = program(SCANNED)
    for number, raw in enumerate((5, 90, 7), 1):
        made.raw = raw
        scan(made, number)
    found = why(made, "q")
    assert found["variables"] == {"grid[1, 2]": "70"}
    assert [shown(one) for one in found["inside"]] == [
        ("grid[1, 2]", 7, 3, "grid[1, n MOD 2 + 1] := levels[n] * 10"),
        ("levels[3]", 6, 3, "levels[n] := raw"),
    ]


def test_a_copy_of_the_program_has_the_same_records_and_lines_are_no_part_of_the_state() -> None:
    made, other = program(SCANNED), program("\n" + SCANNED)
    for one in (made, other):
        one.raw = 90
        scan(one)
    assert made.whole_state(0) == other.whole_state(0)
    copied = copy.deepcopy(made)
    scan(made, 2)
    assert shown(why(copied, "alarm")["inside"][0]) == ("levels[1]", 6, 1, "levels[n] := raw")


RECORDS = """TYPE Tank : STRUCT level : INT; marks : ARRAY[1..2] OF INT; END_STRUCT END_TYPE
FUNCTION_BLOCK Filler
VAR_INPUT by : INT; END_VAR
VAR_IN_OUT tank : Tank; total : INT; marks : ARRAY[1..2] OF INT; END_VAR
VAR last : INT; END_VAR
  last := by + 1;
  tank.level := tank.level + last;
  total := total + last;
  marks[by] := total;
END_FUNCTION_BLOCK
PROGRAM p
VAR_INPUT on : BOOL; END_VAR
VAR_OUTPUT q, r, s, sum : INT; END_VAR
VAR a, b : Filler; tanks : ARRAY[1..2] OF Tank; total : INT; END_VAR
  a(by := 1, tank := tanks[1], total := total, marks := tanks[1].marks);
  IF on THEN
    b(by := 2, tank := tanks[2], total := sum, marks := tanks[2].marks);
  END_IF
  q := tanks[1].level;
  r := tanks[2].marks[2];
  s := tanks[1].marks[1];
END_PROGRAM
"""


def test_a_member_that_an_instance_assigned_through_a_var_in_out_is_followed_into_the_instance() -> None:
    made = program(RECORDS)
    scan(made)
    (inside,) = why(made, "q")["inside"]
    assert shown(inside) == ("tanks[1].level", 7, 1, "tank.level := tank.level + last")
    assert inside["block"] == "Filler"
    assert inside["variables"] == {"tank.level": "2", "last": "2"}


def test_an_output_that_an_instance_assigned_through_a_var_in_out_has_the_line_in_the_block() -> None:
    made = program(RECORDS)
    made.on = True
    scan(made)
    place = made.last_assignment("sum")[0]
    assert place is not None
    assert place.line == 8
    found = why(made, "sum")
    assert (found["statement"], found["variables"]) == ("total := total + last", {"total": "3", "last": "3"})


def test_an_element_of_a_member_is_followed_through_the_var_in_out_of_one_of_two_instances() -> None:
    made = program(RECORDS)
    made.on = True
    scan(made, 1)
    made.on = False
    scan(made, 2)
    for name, index, number in (("r", 2, 1), ("s", 1, 2)):
        inside = why(made, name)["inside"][0]
        assert shown(inside) == (f"tanks[{index}].marks[{index}]", 9, number, "marks[by] := total")
        assert inside["indices"] == {"by": str(index)}


def test_the_instance_that_executed_the_statement_last_is_named() -> None:
    made = program(
        """FUNCTION_BLOCK Counter
VAR_IN_OUT n : INT; END_VAR
  n := n + 1;
END_FUNCTION_BLOCK
PROGRAM p
VAR_OUTPUT q : INT; END_VAR
VAR a, b : Counter; END_VAR
  a(n := q);
  b(n := q);
END_PROGRAM"""
    )
    scan(made)
    found = why(made, "q")
    assert (found["statement"], found["executed_in"], found["variables"]) == ("n := n + 1", "b", {"n": "2"})


def test_an_index_that_changed_after_the_condition_is_not_shown() -> None:
    made = program(
        """PROGRAM p
VAR_OUTPUT q : BOOL; END_VAR
VAR i : INT := 1; a : ARRAY[1..3] OF INT := [5, 0, 0]; END_VAR
  IF a[i] > 3 THEN
    i := i + 1;
    q := TRUE;
  END_IF
END_PROGRAM"""
    )
    scan(made)
    found = why(made, "q")
    assert found["notes"] == ["a[i]: i may have changed between the condition and this line"]
    assert (found["variables"], found["indices"]) == ({}, {"i": "2"})


def test_whole_arrays_rows_and_structures_have_the_line_of_the_last_assignment() -> None:
    made = program(
        """TYPE R : STRUCT x, y : INT; END_STRUCT Row : ARRAY[1..2] OF INT; END_TYPE
PROGRAM p
VAR_OUTPUT q, r, s, t : INT; END_VAR
VAR a : ARRAY[1..2] OF Row; other : Row; b : ARRAY[1..2] OF R; one : R; END_VAR
  a[1][2] := 3;
  a[2][1] := 4;
  a[1] := other;
  b[1].x := 1;
  b[2] := one;
  b[2].y := 1;
  q := a[1][2];
  r := a[2][1];
  s := b[2].x;
  t := b[2].y;
END_PROGRAM"""
    )
    scan(made)
    lines = {name: shown(why(made, name)["inside"][0])[1] for name in "qrst"}
    assert lines == {"q": 7, "r": 6, "s": 9, "t": 10}


def test_an_element_that_an_output_of_a_call_or_a_reference_assigned_is_followed() -> None:
    made = program(
        """FUNCTION_BLOCK Sensor
VAR_OUTPUT value : INT; END_VAR
VAR k : INT := 7; END_VAR
  value := k * 2;
END_FUNCTION_BLOCK
PROGRAM p
VAR_OUTPUT q, r, s : INT; END_VAR
VAR sensors : ARRAY[1..2] OF Sensor; a, b : ARRAY[1..2] OF INT; i : INT := 2; at : REF_TO INT; END_VAR
  sensors[i](value => a[i]);
  at := REF(b[1]);
  at^ := 4;
  q := a[2];
  r := b[1];
  s := sensors[i].value;
END_PROGRAM"""
    )
    scan(made)
    assert [shown(one) for one in why(made, "q")["inside"]] == [
        ("a[2]", 9, 1, "sensors[i](value => a[i])"),
        ("sensors[2]", 4, 0, "value := k * 2"),
    ]
    assert shown(why(made, "r")["inside"][0]) == ("b[1]", 11, 1, "at^ := 4")
    assert why(made, "s")["inside"][0]["variables"] == {"k": "7"}


def test_an_array_that_a_function_received_as_var_in_out_has_the_line_of_the_call() -> None:
    made = program(
        """FUNCTION Fill : INT
VAR_IN_OUT a : ARRAY[1..3] OF INT; END_VAR
  a[2] := 5;
  Fill := 0;
END_FUNCTION
PROGRAM p
VAR_OUTPUT q, r : INT; END_VAR
VAR a : ARRAY[1..3] OF INT; rows : ARRAY[1..2] OF ARRAY[1..3] OF INT; i : INT := 1; END_VAR
  a[2] := 1;
  IF r < 0 OR Fill(a := rows[i]) = 0 AND Fill(a := a) = 0 THEN
    r := 1;
  END_IF
  q := a[2];
END_PROGRAM"""
    )
    scan(made)
    assert shown(why(made, "q")["inside"][0])[1:] == (10, 1, "")


def test_an_element_that_depends_on_itself_is_followed_once() -> None:
    made = program(
        """PROGRAM p VAR_OUTPUT q : INT; END_VAR VAR a : ARRAY[1..2] OF INT; END_VAR
  a[1] := a[1] + 1;
  q := a[1];
END_PROGRAM"""
    )
    scan(made)
    assert [shown(one)[1] for one in why(made, "q")["inside"]] == [2]


def test_a_tag_at_a_part_of_a_variable_has_a_line_until_it_is_set_from_outside() -> None:
    made = program(
        """TYPE Drive : STRUCT run : BOOL; END_STRUCT END_TYPE
PROGRAM p
VAR drive AT %Q* : Drive; speeds AT %Q* : ARRAY[1..2] OF INT; i : INT := 2; END_VAR
  drive.run := TRUE;
  speeds[i] := 4;
END_PROGRAM""",
        dialect="codesys",
    )
    scan(made)
    for name, value, line, statement in (
        ("drive.run", 0, 4, "drive.run := TRUE"),
        ("speeds[2]", 9, 5, "speeds[i] := 4"),
    ):
        place = made.last_assignment(name)[0]
        assert (place and place.line, why(made, name)["statement"]) == (line, statement)
        made.put(name, value)
        assert made.last_assignment(name)[0] is None


def test_memory_has_the_statement_that_wrote_it_last() -> None:
    made = program(
        """TYPE U : UNION w : WORD; b : ARRAY[0..1] OF BYTE; END_UNION R : STRUCT x : INT; END_STRUCT END_TYPE
PROGRAM p
VAR_OUTPUT q, r, s : INT; END_VAR
VAR u, bytes, set, other : U; a, b : ARRAY[0..3] OF INT; one, two : R; i : INT := 1; END_VAR
VAR_OUTPUT t, v, w, x, y : INT; END_VAR
  u.b[1] := 1;
  u.w := 5;
  bytes.b[0] := 9;
  other := bytes;
  set.w := 7;
  MEMSET(ADR(set), 1, SIZEOF(set));
  a[0] := 4;
  a[2] := 5;
  one.x := 3;
  MEMCPY(ADR(a[i]), ADR(b), 2 * SIZEOF(b[0]));
  v := UDINT_TO_INT(MEMCPY(ADR(one), ADR(two), SIZEOF(one)));
  q := u.b[1];
  r := a[2];
  s := one.x;
  t := a[0];
  w := bytes.w;
  x := set.w;
  y := other.w;
END_PROGRAM""",
        dialect="twincat",
    )
    scan(made)
    assert [shown(why(made, name)["inside"][0]) for name in "qrstwxy"] == [
        ("u.b[1]", 7, 1, "u.w := 5"),
        ("a[2]", 15, 1, "MEMCPY(ADR(a[i]), ADR(b), 2 * SIZEOF(b[0]))"),
        ("one.x", 16, 1, "v := UDINT_TO_INT(MEMCPY(ADR(one), ADR(two), SIZEOF(one)))"),
        ("a[0]", 12, 1, "a[0] := 4"),
        ("bytes.w", 8, 1, "bytes.b[0] := 9"),
        ("set.w", 11, 1, "MEMSET(ADR(set), 1, SIZEOF(set))"),
        ("other.w", 9, 1, "other := bytes"),
    ]


def test_an_array_that_was_assigned_through_a_reference_has_the_line_of_the_statement() -> None:
    made = program(
        """TYPE Grid : ARRAY[1..2, 1..2] OF INT; Row : ARRAY[1..2] OF INT; END_TYPE
PROGRAM p
VAR_OUTPUT q, r, s : INT; END_VAR
VAR a, b : Grid; to_grid : REF_TO Grid; rows : ARRAY[1..2] OF Row; one : Row; to_row : REF_TO Row; END_VAR
  a[1, 1] := 1;
  rows[1][2] := 1;
  rows[2][2] := 1;
  to_grid := REF(a);
  to_grid^ := b;
  to_row := REF(rows[1]);
  to_row^ := one;
  to_row := REF(rows[2]);
  to_row^[2] := 3;
  q := a[1, 1];
  r := rows[1][2];
  s := rows[2][2];
END_PROGRAM"""
    )
    scan(made)
    assert [shown(why(made, name)["inside"][0])[1] for name in "qrs"] == [9, 11, 13]
