"""The statements that assigned global variables, in the program, the instance or the function that executed them."""

from __future__ import annotations

import copy
from typing import Any

from st_bench import scan

from fieldtwin.plc.binding import BoundProgram
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.dialects import DIALECTS
from fieldtwin.plc.st.program import StProgram, program_class


def programs(text: str, *names: str, dialect: str = "standard") -> list[StProgram]:
    """Return programs of one text, which share its global variables."""
    unit, together = compile_text(text, "test.st", DIALECTS[dialect]), {}
    return [program_class(unit, name)(together) for name in names]


def why(made: StProgram, name: str) -> dict[str, Any]:
    place, found = made.last_assignment(name)
    assert place is not None
    assert found is not None
    return {"line": place.line, **found.describe()}


def shown(one: dict[str, Any]) -> tuple[Any, ...]:
    """Return the variable, the line, the scan and the text of a statement."""
    return one["instance"], int(one["place"].rpartition(":")[2]), one.get("scan", 0), one["statement"]


TEXT = """FUNCTION_BLOCK Pump
VAR_INPUT go : BOOL; END_VAR
VAR_EXTERNAL pressure : INT; lamp : BOOL; END_VAR
  IF go THEN
    pressure := pressure + 10;
  END_IF
  IF pressure > 15 THEN
    lamp := TRUE;
  END_IF
END_FUNCTION_BLOCK
VAR_GLOBAL
  pressure : INT;
  lamp AT %QX0.0 : BOOL;
  pump : Pump;
END_VAR
PROGRAM fast
VAR_EXTERNAL lamp : BOOL; pressure, demand : INT; END_VAR
VAR_OUTPUT high : BOOL; END_VAR
VAR local : INT; END_VAR
  local := local + 1;
  IF pressure > 15 AND demand = 1 THEN
    high := lamp;
  END_IF
END_PROGRAM
PROGRAM slow
VAR_INPUT wanted : INT; END_VAR
VAR own : Pump; local : INT := 7; END_VAR
  demand := wanted + local - 7;
  own(go := demand = 1);
END_PROGRAM
VAR_GLOBAL demand : INT; END_VAR
"""


def scanned(scans: int = 2) -> tuple[StProgram, StProgram]:
    fast, slow = programs(TEXT, "fast", "slow")
    slow.wanted = 1
    for number in range(1, scans + 1):
        scan(slow, number)
        scan(fast, number)
    return fast, slow


def test_a_global_output_has_the_statement_in_the_instance_that_assigned_it() -> None:
    fast, _ = scanned()
    found = why(fast, "lamp")
    assert (found["line"], found["statement"], found["executed_in"]) == (8, "lamp := TRUE", "own of program slow")
    assert found["conditions"] == [{"line": 7, "text": "pressure > 15", "holds": True}]
    assert found["variables"] == {"pressure": "20"}
    assert [shown(one) for one in found["inside"]] == [("pressure", 5, 2, "pressure := pressure + 10")]


def test_a_global_that_a_condition_reads_is_followed_into_another_program() -> None:
    fast, _ = scanned()
    found = why(fast, "high")
    assert found["variables"] == {"pressure": "20", "demand": "1", "lamp": "TRUE"}
    inside = {one["instance"]: one for one in found["inside"]}
    assert shown(inside["demand"]) == ("demand", 28, 2, "demand := wanted + local - 7")
    assert inside["demand"]["executed_in"] == "program slow"
    # the inputs and variables of the program that executed the statement, although this program has a `local` as well
    assert inside["demand"]["variables"] == {"wanted": "1", "local": "7"}
    assert shown(inside["pressure"]) == ("pressure", 5, 2, "pressure := pressure + 10")
    assert (inside["pressure"]["block"], inside["pressure"]["executed_in"]) == ("Pump", "own of program slow")
    assert inside["pressure"]["variables"] == {"go": "TRUE", "pressure": "20"}
    assert shown(inside["lamp"]) == ("lamp", 8, 2, "lamp := TRUE")


def test_a_global_that_a_program_assigned_later_has_the_statement_of_that_program() -> None:
    first, second = programs(
        """VAR_GLOBAL valve AT %QX0.0 : BOOL; END_VAR
PROGRAM first VAR_EXTERNAL valve : BOOL; END_VAR
  valve := TRUE;
END_PROGRAM
PROGRAM second VAR_EXTERNAL valve : BOOL; END_VAR VAR_INPUT off : BOOL; END_VAR
  IF off THEN
    valve := FALSE;
  END_IF
END_PROGRAM""",
        "first",
        "second",
    )
    scan(first)
    scan(second)
    assert (why(first, "valve")["line"], why(first, "valve").get("executed_in")) == (3, None)
    second.off = True
    scan(second, 2)
    found = why(first, "valve")
    assert (found["line"], found["executed_in"], found["variables"]) == (7, "program second", {"off": "TRUE"})


def test_a_global_of_a_list_an_instance_in_it_and_an_element_are_followed() -> None:
    (made,) = programs(
        """TYPE Tank : STRUCT level : INT; END_STRUCT END_TYPE
FUNCTION_BLOCK Filler
VAR_OUTPUT done : BOOL; END_VAR
  done := TRUE;
END_FUNCTION_BLOCK
VAR_GLOBAL CONSTANT most : INT := 3; END_VAR
VAR_GLOBAL limit : INT; levels : ARRAY[1..3] OF INT; tank : Tank; filler : Filler; i : INT := 1; END_VAR
PROGRAM p
VAR_OUTPUT q, r, s : BOOL; END_VAR
  limit := most - 1;
  levels[i] := 5;
  tank.level := 6;
  filler();
  IF levels[i] > limit THEN
    q := tank.level > most;
  END_IF
  r := filler.done;
END_PROGRAM""",
        "p",
        dialect="codesys",
    )
    scan(made)
    found = why(made, "q")
    assert found["variables"] == {"levels[1]": "5", "limit": "2", "tank.level": "6"}
    assert [shown(one) for one in found["inside"]] == [
        ("levels[1]", 11, 1, "levels[i] := 5"),
        ("limit", 10, 1, "limit := most - 1"),
        ("tank.level", 12, 1, "tank.level := 6"),
    ]
    assert shown(why(made, "r")["inside"][0]) == ("filler", 4, 0, "done := TRUE")


def test_a_global_that_a_function_assigned_has_its_statement_and_the_globals_that_it_read() -> None:
    (made,) = programs(
        """VAR_GLOBAL count, step : INT; END_VAR
FUNCTION Advance : INT
VAR_INPUT by : INT; END_VAR
VAR_EXTERNAL count, step : INT; END_VAR
  step := 2;
  count := count + step * by;
  Advance := count;
END_FUNCTION
PROGRAM p
VAR_EXTERNAL count : INT; END_VAR
VAR_OUTPUT q : BOOL; END_VAR
VAR by : INT := 9; used : INT; END_VAR
  used := Advance(by := 3);
  q := count > 5;
END_PROGRAM""",
        "p",
    )
    scan(made)
    count, step = why(made, "q")["inside"]
    assert shown(count) == ("count", 6, 1, "count := count + step * by")
    assert count["variables"] == {"count": "6", "step": "2"}  # not the `by` of the program
    assert count["notes"] == ["the variables of a function are not kept after the call"]
    assert shown(step) == ("step", 5, 1, "step := 2")


def test_a_local_variable_of_a_method_with_the_name_of_a_global_is_not_taken_for_it() -> None:
    (made,) = programs(
        """VAR_GLOBAL level : INT := 70; mark : INT; END_VAR
FUNCTION_BLOCK Box
METHOD PUBLIC Set
VAR level : INT; END_VAR
VAR_EXTERNAL mark : INT; END_VAR
  level := 4;
  mark := level + 1;
END_METHOD
END_FUNCTION_BLOCK
PROGRAM p
VAR_EXTERNAL mark : INT; END_VAR
VAR_OUTPUT q : INT; END_VAR
VAR box : Box; END_VAR
  box.Set();
  q := mark;
END_PROGRAM""",
        "p",
    )
    scan(made)
    (mark,) = why(made, "q")["inside"]
    assert shown(mark) == ("mark", 7, 1, "mark := level + 1")
    assert (mark["variables"], mark["executed_in"]) == ({}, "box")


def test_a_value_from_outside_has_no_statement_and_a_copy_keeps_its_own() -> None:
    fast, slow = scanned()
    copied = copy.deepcopy(fast)
    fast.put("lamp", False)
    assert fast.last_assignment("lamp") == (None, None)
    scan(slow, 3)
    assert why(fast, "lamp")["inside"][0]["scan"] == 3
    found = why(copied, "lamp")
    assert (found["inside"][0]["scan"], found["executed_in"]) == (2, "own of program slow")


def test_records_of_globals_are_no_part_of_the_state() -> None:
    states = []
    for lines in ("", "\n\n"):
        (made,) = programs(f"{lines}VAR_GLOBAL n : INT; END_VAR PROGRAM p n := 4; END_PROGRAM", "p")
        scan(made)
        states.append(made.whole_state(0))
    assert states[0] == states[1]


def test_two_programs_that_run_one_program_are_told_apart() -> None:
    """Defect: both had the name of the PROGRAM, so a reader could not tell which of them assigned a variable."""
    text = """VAR_GLOBAL total : INT; END_VAR
FUNCTION_BLOCK Part VAR_INPUT x : INT; END_VAR VAR_EXTERNAL total : INT; END_VAR
  IF x > 0 THEN total := x; END_IF
END_FUNCTION_BLOCK
PROGRAM Line VAR_INPUT n : INT; END_VAR VAR part : Part; END_VAR
  part(x := n);
END_PROGRAM
PROGRAM Sum VAR_EXTERNAL total : INT; END_VAR VAR_OUTPUT shown : INT; END_VAR
  shown := total;
END_PROGRAM"""
    unit, together = compile_text(text, "test.st"), {}
    bound = [
        BoundProgram(name, program_class(unit, pou)(together))
        for name, pou in (("left", "Line"), ("right", "Line"), ("sum", "Sum"))
    ]
    left, right, total = [one.program for one in bound]
    for number, writer in enumerate((left, right, left), 1):
        left.n, right.n = (number if one is writer else 0 for one in (left, right))
        for one in (left, right, total):
            scan(one, number)
        (inside,) = why(total, "shown")["inside"]
        assert inside["executed_in"] == f"part of program {'left' if writer is left else 'right'}"
