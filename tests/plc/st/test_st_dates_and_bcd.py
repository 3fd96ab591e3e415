"""Functions of binary coded decimals, of times by name, and CONCAT and SPLIT of dates.

Source: IEC 61131-3:2013, 6.6.2.5.3, and tables 35 and 36.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import pytest
from st_bench import program, run, scan, value

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.dialects import DIALECTS
from fieldtwin.plc.st.program import program_class
from fieldtwin.plc.st.values import LogicError

S = 1_000_000_000


def since_1970(*at: int) -> int:
    return int((datetime(*at, tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds()) * S  # type: ignore[arg-type, misc]


@pytest.mark.parametrize(
    ("kind", "expression", "expected"),
    [
        ("UINT", "WORD_BCD_TO_UINT(WORD#16#1234)", 1234),
        ("INT", "BCD_TO_INT(WORD#16#1234)", 1234),
        ("INT", "BCD_TO_INT(BYTE#16#42)", 42),
        ("DINT", "DWORD_BCD_TO_DINT(DWORD#16#9876_5432)", 98_765_432),
        ("WORD", "INT_TO_BCD(1234)", 0x1234),
        ("BYTE", "USINT_TO_BCD(42)", 0x42),
        ("DWORD", "INT_TO_BCD_DWORD(7)", 7),
        ("WORD", "TO_BCD_WORD(INT#99)", 0x99),
    ],
)
def test_a_decimal_digit_has_four_bits(kind: str, expression: str, expected: int) -> None:
    assert value(kind, expression) == expected


@pytest.mark.parametrize(
    ("expression", "message"),
    [("BCD_TO_INT(w)", "16#1A"), ("WORD_TO_INT(INT_TO_BCD(negative))", "0 to 9999")],
)
def test_a_value_that_is_no_decimal_stops_the_task(expression: str, message: str) -> None:
    with pytest.raises(LogicError) as e:
        value("INT", expression, "w : WORD := 16#1A; negative : INT := -1;")
    assert message in f"{e.value.expected} {e.value.got}"


def test_codesys_gives_a_byte_for_int_to_bcd() -> None:
    text = "PROGRAM p VAR b : BYTE; i : INT := 42; END_VAR b := INT_TO_BCD(i); END_PROGRAM"
    made = program_class(compile_text(text, "test.st", DIALECTS["codesys"]))()
    scan(made)
    assert made.st_body.v_b == 0x42
    with pytest.raises(FileInvalid, match="WORD"):
        program(text)  # elsewhere the result is as wide as the number


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("MULTIME(T#2s, 3)", 6 * S),
        ("MULTIME(T#2s, 1.5)", 3 * S),
        ("DIVTIME(T#5s, 2)", 5 * S // 2),
        ("ADD_LTIME(LT#2s, LT#3s)", 5 * S),
        ("SUB_LTIME(LT#2s, LT#3s)", -S),
        ("MUL_LTIME(LT#2s, 4)", 8 * S),
        ("DIV_LTIME(LT#2s, 4)", S // 2),
        ("SUB_LTOD_LTOD(LTOD#12:00:00, LTOD#11:59:00)", 60 * S),
        ("SUB_LDATE_LDATE(LDATE#1984-06-26, LDATE#1984-06-25)", 86_400 * S),
        ("SUB_LDT_LDT(LDT#1984-06-25-00:01:00, LDT#1984-06-25-00:00:00)", 60 * S),
    ],
)
def test_arithmetic_of_times_by_name(expression: str, expected: int) -> None:
    assert value("LTIME", expression) == expected


@pytest.mark.parametrize(
    ("kind", "expression", "expected"),
    [
        ("LTOD", "ADD_LTOD_LTIME(LTOD#15:36:55, LT#5s)", (15 * 3600 + 37 * 60) * S),
        ("LTOD", "SUB_LTOD_LTIME(LTOD#15:36:55, LT#55s)", (15 * 3600 + 36 * 60) * S),
        ("LDT", "ADD_LDT_LTIME(LDT#1984-06-25-15:36:55, LT#5s)", since_1970(1984, 6, 25, 15, 37)),
        ("LDT", "SUB_LDT_LTIME(LDT#1984-06-25-15:36:55, LT#55s)", since_1970(1984, 6, 25, 15, 36)),
    ],
)
def test_a_duration_moves_a_long_moment(kind: str, expression: str, expected: int) -> None:
    assert value(kind, expression) == expected


def test_the_difference_of_long_moments_counts_ns_as_a_number() -> None:
    assert value("LINT", "LTIME_TO_LINT(SUB_LDT_LDT(LDT#1984-06-25-00:00:01, LDT#1984-06-25-00:00:00))") == S


@pytest.mark.parametrize(
    ("kind", "expression", "expected"),
    [
        ("DATE", "CONCAT_DATE(1984, 6, 25)", since_1970(1984, 6, 25)),
        ("DATE", "CONCAT_DATE(DAY := 25, MONTH := 6, YEAR := 1984)", since_1970(1984, 6, 25)),
        ("TOD", "CONCAT_TOD(15, 36, 55, 360)", (15 * 3600 + 36 * 60 + 55) * S + 360_000_000),
        ("LTOD", "CONCAT_LTOD(15, 36, 55, 360)", (15 * 3600 + 36 * 60 + 55) * S + 360_000_000),
        ("DT", "CONCAT_DT(1984, 6, 25, 15, 36, 55, 0)", since_1970(1984, 6, 25, 15, 36, 55)),
        ("LDT", "CONCAT_LDT(1984, 6, 25, 15, 36, 55, 1)", since_1970(1984, 6, 25, 15, 36, 55) + 1_000_000),
        ("DT", "CONCAT_DATE_LTOD(D#1984-06-25, LTOD#15:36:55)", since_1970(1984, 6, 25, 15, 36, 55)),
        ("INT", "DAY_OF_WEEK(D#1984-06-25)", 1),  # a Monday
        ("USINT", "DAY_OF_WEEK(D#1969-12-28)", 0),  # a Sunday
    ],
)
def test_concat_and_day_of_week(kind: str, expression: str, expected: int) -> None:
    assert value(kind, expression) == expected


def _split(call: str) -> dict[str, Any]:
    return run("y : UINT; mo : USINT; d, h, mi, s, ms : INT;", call)


def test_split_gives_the_parts_of_a_moment() -> None:
    found = _split(
        "SPLIT_DT(IN := DT#1984-06-25-15:36:55.36, YEAR => y, MONTH => mo, DAY => d, HOUR => h, MINUTE => mi, SECOND => s,"
        " MILLISECOND => ms);"
    )
    assert [found[name] for name in ("y", "mo", "d", "h", "mi", "s", "ms")] == [1984, 6, 25, 15, 36, 55, 360]


def test_split_gives_only_the_outputs_that_are_connected() -> None:
    found = _split("SPLIT_DATE(D#1984-06-25, MONTH => mo); SPLIT_TOD(TOD#15:36:55, MINUTE => mi);")
    assert (found["y"], found["mo"], found["d"], found["mi"]) == (0, 6, 0, 36)


def test_a_part_that_its_variable_cannot_hold_stops_the_task() -> None:
    with pytest.raises(LogicError, match="does not fit"):
        run("y : SINT;", "SPLIT_DATE(IN := D#1984-06-25, YEAR => y);")


@pytest.mark.parametrize(
    "expression",
    ["CONCAT_DATE(1983, 2, 29)", "CONCAT_DATE(3000, 1, 1)", "CONCAT_DATE(0, 1, 1)", "CONCAT_DATE(1983, 13, 1)"],
)
def test_a_date_that_does_not_exist_stops_the_task(expression: str) -> None:
    with pytest.raises(LogicError, match="a date"):
        value("DATE", expression)


def test_a_time_of_day_that_does_not_exist_stops_the_task() -> None:
    with pytest.raises(LogicError, match="a time of day"):
        value("TOD", "CONCAT_TOD(24, 0, 0, 0)")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("SPLIT_DATE(IN := D#1984-06-25, HOUR => h);", "HOUR"),
        ("SPLIT_DATE(IN := D#1984-06-25, YEAR => r);", "an integer"),
        ("SPLIT_DATE(IN := T#1s, YEAR => h);", "date"),
        ("h := SPLIT_DATE(D#1984-06-25);", "no result"),
    ],
)
def test_a_wrong_call_of_split_is_an_error(call: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        run("h : INT; r : REAL;", call)
