"""VAR RETAIN and VAR NON_RETAIN in function blocks (IEC 61131-3:2013, 6.5.6.1 and table 15).

After a warm restart, variables of VAR RETAIN have their retained values in each instance of the block, also in one that is not
RETAIN itself, and all others have their initial values.
"""

from __future__ import annotations

import json
from typing import Any

import pytest
from st_bench import program, run, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.program import StProgram

METER = """TYPE Day : STRUCT hours : INT; END_STRUCT; END_TYPE
FUNCTION_BLOCK Meter
VAR_INPUT by : INT := 1; END_VAR
VAR RETAIN total : INT; days : ARRAY[0..1] OF Day; text : STRING := 'new'; END_VAR
VAR since : INT; END_VAR VAR NON_RETAIN last : INT; END_VAR
  total := total + by; since := since + by; last := by; days[1].hours := total; text := 'used';
END_FUNCTION_BLOCK
FUNCTION_BLOCK Station VAR a, b : Meter; n : INT; END_VAR a(); b(by := 10); n := n + 1; END_FUNCTION_BLOCK
"""


def restarted(text: str, scans: int = 2) -> tuple[StProgram, dict[str, Any]]:
    """Return a new instance of a program with the retained values of one that made `scans` scans, and these values."""
    first, second = program(text), program(text)
    for number in range(1, scans + 1):
        scan(first, number)
    kept = json.loads(json.dumps(first.retained()))
    second.restore(kept)
    return second, kept


def test_a_block_retains_its_variables_of_var_retain_only() -> None:
    made, kept = restarted(f"{METER} PROGRAM p VAR m : Meter; x : INT; END_VAR m(); x := 1; END_PROGRAM")
    meter = made.st_body.v_m
    assert (meter.v_total, meter.v_days[1].m_hours, meter.v_text) == (2, 2, "used")
    assert (meter.v_since, meter.v_last, made.st_body.v_x) == (0, 0, 0)
    assert list(kept) == ["m"]


def test_blocks_inside_blocks_and_arrays_retain_their_variables() -> None:
    made, _ = restarted(
        f"{METER} PROGRAM p VAR s : ARRAY[1..2] OF Station; END_VAR s[1](); s[2](); s[2](); END_PROGRAM", 1
    )
    stations = made.st_body.v_s
    assert [(one.v_a.v_total, one.v_b.v_total, one.v_n) for one in stations] == [(1, 10, 0), (2, 20, 0)]


def test_a_retained_block_does_not_retain_its_variables_of_var_non_retain() -> None:
    made, _ = restarted(f"{METER} PROGRAM p VAR RETAIN m : Meter; END_VAR m(by := 5); END_PROGRAM")
    meter = made.st_body.v_m
    assert (meter.v_total, meter.v_since, meter.v_last) == (10, 10, 0)


def test_a_program_without_retained_variables_retains_nothing() -> None:
    made = program(f"{METER} PROGRAM p VAR t : TON; x : INT; END_VAR t(); x := 1; END_PROGRAM")
    scan(made)
    assert (made.retained(), made.retain_layout(), made.retain_bytes()) == ({}, [], 0)


def test_an_extending_block_retains_the_variables_of_its_base() -> None:
    text = f"""{METER} FUNCTION_BLOCK Big EXTENDS Meter VAR RETAIN more : INT; END_VAR
    SUPER(); more := more + 100; END_FUNCTION_BLOCK
    PROGRAM p VAR b : Big; END_VAR b(); END_PROGRAM"""
    made, _ = restarted(text)
    assert (made.st_body.v_b.v_total, made.st_body.v_b.v_more, made.st_body.v_b.v_since) == (2, 200, 0)


@pytest.mark.parametrize(
    ("before", "message"),
    [
        (
            "FUNCTION f : INT VAR RETAIN x : INT; END_VAR f := 1; END_FUNCTION",
            "a variable of a FUNCTION cannot be RETAIN",
        ),
        (
            "FUNCTION_BLOCK f VAR RETAIN x : REF_TO INT; END_VAR ; END_FUNCTION_BLOCK",
            "x, a REF_TO INT, cannot be RETAIN",
        ),
        ("FUNCTION_BLOCK f VAR_TEMP RETAIN x : INT; END_VAR ; END_FUNCTION_BLOCK", "cannot be RETAIN"),
    ],
)
def test_what_cannot_be_retained_is_an_error(before: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        run("x : INT;", ";", before)


@pytest.mark.parametrize(
    ("before", "after", "same"),
    [
        ("text : STRING :=", "text : STRING[20] :=", False),
        ("hours : INT;", "hours : INT; more : REAL;", False),
        ("RETAIN total : INT;", "RETAIN more : REAL; total : INT;", False),
        ("VAR NON_RETAIN last : INT;", "VAR NON_RETAIN last : DINT;", True),
        ("since := since + by;", "since := since + 2;", True),
    ],
)
@pytest.mark.parametrize("qualifier", ["", "RETAIN"])
def test_retained_values_belong_to_the_declarations_of_their_block(
    before: str, after: str, same: bool, qualifier: str
) -> None:
    main = f"PROGRAM p VAR {qualifier} s : ARRAY[1..2] OF Station; END_VAR s[1](); END_PROGRAM"
    assert before in METER
    layouts = [program(f"{text} {main}").retain_layout() for text in (METER, METER.replace(before, after))]
    assert (layouts[0] == layouts[1]) is same


def test_a_variable_that_is_not_retained_changes_no_retained_values() -> None:
    main = "PROGRAM p VAR m : Meter; END_VAR m(); END_PROGRAM"
    changed = METER.replace("VAR since : INT;", "VAR since : DINT; more : REAL;")
    assert program(METER + main).retain_layout() == program(changed + main).retain_layout()


def test_global_variables_of_any_type_are_retained_if_their_list_is() -> None:
    made, kept = restarted(f"""{METER}
        VAR_GLOBAL RETAIN hours : INT := 5; day : Day; a : ARRAY[1..2] OF INT; name : STRING; m : Meter; unused : INT; END_VAR
        VAR_GLOBAL others : INT; END_VAR
        FUNCTION_BLOCK Clock hours := hours + 1; END_FUNCTION_BLOCK
        PROGRAM p VAR c : Clock; END_VAR
        c(); day.hours := hours; a[2] := a[2] + 3; name := CONCAT(name, 'x'); m(); others := others + 1; END_PROGRAM""")
    found = made.st_resource.globals
    assert (found.v_hours, found.v_day.m_hours, found.v_a, found.v_name) == (7, 7, [0, 6], "xx")
    assert (found.v_m.v_total, found.v_others, found.v_unused) == (2, 0, 0)
    assert list(kept) == ["hours", "day", "a", "name", "m"]


def test_a_reference_in_a_retained_global_list_is_refused() -> None:
    with pytest.raises(FileInvalid, match="x, a REF_TO INT, cannot be RETAIN"):
        program("VAR_GLOBAL RETAIN x : REF_TO INT; END_VAR PROGRAM p x := NULL; END_PROGRAM")
