"""Unit tests in Structured Text: TEST blocks with assertions, and their virtual time."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.source_files import source_files
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.dialects import dialect_of
from fieldtwin.plc.st.unit_tests.run import AssertionResult, TestResult
from fieldtwin.plc.st.unit_tests.suite import load_suite

PUMP = """
TYPE States : (IDLE, FILLING, FAULT); END_TYPE
PROGRAM Pump
VAR_INPUT start : BOOL; level : REAL; END_VAR
VAR valve AT %QX0.0 : BOOL; END_VAR
VAR RETAIN starts : INT; END_VAR
VAR state : States; guard : TON; END_VAR
  guard(IN := state = FILLING, PT := T#30s);
  IF NOT IS_GOOD(level) OR guard.Q THEN state := FAULT; END_IF
  IF state = IDLE AND start THEN state := FILLING; starts := starts + 1; END_IF
  valve := state = FILLING;
END_PROGRAM
"""


def ran(
    folder: Path, tests: str, beside: str = PUMP, name: str = "pump.test.st", dialect: str = "standard"
) -> list[TestResult]:
    (folder / "pump.st").write_text(beside)
    (folder / name).write_text(tests)
    return list(load_suite(folder / name, dialect_of(dialect)).run())


def only(results: list[TestResult]) -> AssertionResult:
    assert [one.error for one in results] == [""]
    (assertion,) = results[0].assertions
    return assertion


def test_a_program_is_called_like_a_block_and_its_locals_can_be_read(tmp_path: Path) -> None:
    (result,) = ran(
        tmp_path,
        """TEST 'fills' VAR p : Pump; END_VAR
        p(start := TRUE, level := 1.0);
        ASSERT_EQ(p.state, FILLING); ASSERT_TRUE(p.valve); ASSERT_EQ(p.starts, 1); ASSERT_FALSE(p.guard.Q);
        END_TEST""",
    )
    assert [(one.executed, one.failed) for one in result.assertions] == [(1, False)] * 4


def test_time_passes_with_advance_time_only(tmp_path: Path) -> None:
    (result,) = ran(
        tmp_path,
        """TEST 'time' VAR p : Pump; n : INT; END_VAR
        p(start := TRUE); p();
        FOR n := 1 TO 1000 DO p(); END_FOR
        ASSERT_EQ(p.guard.ET, T#0s);
        ADVANCE_TIME(T#29s999ms); p();
        ASSERT_EQ(p.state, FILLING); ASSERT_EQ(p.guard.ET, T#29s999ms);
        ADVANCE_TIME(T#1ms); p();
        ASSERT_EQ(p.state, FAULT);
        END_TEST""",
    )
    assert not result.failed
    assert result.simulated_ns == 30_000_000_000
    assert [one.t_ns for one in result.assertions] == [0, 29_999_000_000, 29_999_000_000, 30_000_000_000]


def test_the_quality_of_an_input_is_an_input_of_the_test(tmp_path: Path) -> None:
    (result,) = ran(
        tmp_path,
        """TEST 'bad level' VAR p : Pump; END_VAR
        p(level_IS_GOOD := FALSE); ASSERT_EQ(p.state, FAULT); END_TEST""",
    )
    assert not result.failed


@pytest.mark.parametrize(
    ("statement", "expected", "got"),
    [
        ("ASSERT_EQ(p.state, FILLING);", "FILLING", "IDLE"),
        ("ASSERT_EQ(p.guard.PT, T#1m30s);", "T#1m30s", "T#0s"),
        ("ASSERT_NE(n, 5);", "not 5", "5"),
        ("ASSERT_LT(n, 5);", "less than 5", "5"),
        ("ASSERT_LE(n, 4);", "at most 4", "5"),
        ("ASSERT_GT(n, 5);", "more than 5", "5"),
        ("ASSERT_GE(n, 6);", "at least 6", "5"),
        ("ASSERT_TRUE(n = 4);", "TRUE", "FALSE"),
        ("ASSERT_FALSE(n = 5);", "FALSE", "TRUE"),
        ("ASSERT_NEAR(1.5, 1.25, 0.125);", "1.25 within 0.125", "1.5"),
        ("ASSERT_EQ(text, 'full');", "'full'", "'empty'"),
        ("ASSERT_EQ(EXPECTED := 6, IN := n);", "6", "5"),
    ],
)
def test_a_failure_shows_values_as_in_the_source(tmp_path: Path, statement: str, expected: str, got: str) -> None:
    variables = "VAR p : Pump; n : INT := 5; text : STRING := 'empty'; END_VAR"
    failed = only(ran(tmp_path, f"TEST 'x' {variables} {statement} END_TEST"))
    assert (failed.failed, failed.expected, failed.got) == (True, expected, got)


@pytest.mark.parametrize(
    "statement",
    [
        "ASSERT_NE(n, 4);", "ASSERT_LT(n, 6);", "ASSERT_LE(n, 5);", "ASSERT_GT(n, 4);", "ASSERT_GE(n, 5);",
        "ASSERT_NEAR(1.5, 1.25, 0.25);", "ASSERT_NEAR(1.0, 1.25, 0.25);",
    ],
)  # fmt: skip
def test_assertions_that_hold(tmp_path: Path, statement: str) -> None:
    assert not only(ran(tmp_path, f"TEST 'x' VAR n : INT := 5; END_VAR {statement} END_TEST")).failed


def test_a_value_that_is_not_a_number_is_near_nothing(tmp_path: Path) -> None:
    nan = "VAR big : LREAL := 1.0E308; END_VAR big := big * 10.0; big := big - big;"
    assert only(ran(tmp_path, f"TEST 'x' {nan} ASSERT_NEAR(big, 0.0, 1.0E300); END_TEST")).failed


def test_the_first_failure_of_an_assertion_in_a_loop_is_kept(tmp_path: Path) -> None:
    failed = only(
        ran(
            tmp_path,
            """TEST 'x' VAR n : INT; END_VAR
            FOR n := 1 TO 5 DO ADVANCE_TIME(T#1s); ASSERT_LT(n, 3, 'never three'); END_FOR END_TEST""",
        )
    )
    assert (failed.executed, failed.t_ns, failed.got, failed.text.message) == (5, 3_000_000_000, "3", "never three")
    assert failed.text.text == "ASSERT_LT(n, 3)"


def test_each_test_begins_with_initial_values_also_of_global_variables(tmp_path: Path) -> None:
    beside = """VAR_GLOBAL total : INT := 7; END_VAR
    FUNCTION_BLOCK Counting VAR_EXTERNAL total : INT; END_VAR total := total + 1; END_FUNCTION_BLOCK"""
    body = "VAR c : Counting; END_VAR VAR_EXTERNAL total : INT; END_VAR c(); ASSERT_EQ(total, 8); END_TEST"
    results = ran(tmp_path, f"TEST 'one' {body} TEST 'two' {body}", beside)
    assert [one.failed for one in results] == [[], []]


def test_an_error_in_a_scan_ends_the_test_with_the_line(tmp_path: Path) -> None:
    beside = "FUNCTION Half : INT\nVAR_INPUT by : INT; END_VAR\nHalf := 10 / by;\nEND_FUNCTION"
    first, second = ran(
        tmp_path,
        "TEST 'a' ASSERT_EQ(Half(2), 5); ASSERT_EQ(Half(0), 0); ASSERT_TRUE(FALSE); END_TEST\n"
        "TEST 'b' ASSERT_EQ(Half(5), 2); END_TEST",
        beside,
    )
    assert (first.error, first.error_place) == ("division by zero", (str(tmp_path / "pump.st"), 3))
    assert [one.executed for one in first.assertions] == [1, 0, 0]
    assert not second.error
    assert not second.failed


def test_a_test_that_does_not_end_is_stopped(tmp_path: Path) -> None:
    endless, creeping = ran(
        tmp_path,
        "TEST 'a' WHILE TRUE DO ; END_WHILE END_TEST TEST 'b' WHILE TRUE DO ADVANCE_TIME(T#0s); END_WHILE END_TEST",
    )
    assert endless.error == "more than 1,000,000 loop iterations and calls in one scan"
    assert creeping.error == "more than 1,000,000 calls of ADVANCE_TIME in one test"


def test_time_does_not_go_back(tmp_path: Path) -> None:
    (result,) = ran(tmp_path, "TEST 'a' ADVANCE_TIME(T#-1s); END_TEST")
    assert result.error == "ADVANCE_TIME goes back; expected T#0s or more; got T#-1s"


def test_first_scan_ends_with_the_first_advance(tmp_path: Path) -> None:
    (result,) = ran(
        tmp_path, "TEST 'a' ASSERT_TRUE(FIRST_SCAN()); ADVANCE_TIME(T#1ms); ASSERT_FALSE(FIRST_SCAN()); END_TEST"
    )
    assert not result.failed


def test_a_chart_is_tested_like_any_program(tmp_path: Path) -> None:
    beside = """PROGRAM Chart VAR_INPUT go : BOOL; END_VAR VAR_OUTPUT busy : BOOL; END_VAR
    INITIAL_STEP Rest: END_STEP
    STEP Work: busy(N); END_STEP
    TRANSITION FROM Rest TO Work := go; END_TRANSITION
    TRANSITION FROM Work TO Rest := Work.T >= T#2s; END_TRANSITION
    END_PROGRAM"""
    (result,) = ran(
        tmp_path,
        """TEST 'x' VAR c : Chart; END_VAR
        c(); ASSERT_FALSE(c.busy); c(go := TRUE); ASSERT_TRUE(c.busy);
        ADVANCE_TIME(T#2s); c(go := FALSE); ADVANCE_TIME(T#1ms); c(); ASSERT_FALSE(c.busy); END_TEST""",
        beside,
    )
    assert not result.failed
    assert not result.error


@pytest.mark.parametrize(
    ("test", "error"),
    [
        ("ASSERT_EQL(1, 1);", "ASSERT_EQL is no assertion"),
        ("ASSERT_EQ(1);", "ASSERT_EQ lacks EXPECTED"),
        ("ASSERT_EQ(1, 2, 'text', 4);", "the arguments of ASSERT_EQ"),
        ("ASSERT_EQ(IN := 1, IN := 2);", "the arguments of ASSERT_EQ"),
        ("ASSERT_TRUE(TRUE, 5);", "MESSAGE of ASSERT_TRUE"),
        ("ASSERT_TRUE(5);", "an assertion"),
        ("ASSERT_EQ(1, 'text');", "="),
        ("ADVANCE_TIME(5);", "BY of ADVANCE_TIME"),
        ("VAR_INPUT x : INT; END_VAR ;", "the variables of a test"),
    ],
)
def test_errors_in_tests_have_their_place(tmp_path: Path, test: str, error: str) -> None:
    with pytest.raises(FileInvalid) as raised:
        ran(tmp_path, f"TEST 'a'\n{test} END_TEST")
    assert error in raised.value.message
    assert (raised.value.path, raised.value.line) == (str(tmp_path / "pump.test.st"), 2)


def test_an_error_in_the_tested_program_is_reported_at_its_place(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid) as raised:
        ran(tmp_path, "TEST 'a' VAR p : Pump; END_VAR p(); END_TEST", PUMP.replace("valve := state", "valve = state"))
    assert "not Structured Text" in raised.value.message
    assert (raised.value.path, raised.value.line) == (str(tmp_path / "pump.st"), 11)


def test_a_function_may_have_the_name_of_a_variable_of_its_caller(tmp_path: Path) -> None:
    beside = """FUNCTION Share : INT VAR_INPUT x : INT; END_VAR Share := x / 2; END_FUNCTION
FUNCTION_BLOCK Tank VAR share : INT; END_VAR VAR_OUTPUT n : INT; END_VAR share := Share(8); n := share; END_FUNCTION_BLOCK"""
    test = "TEST 'a' VAR t : Tank; END_VAR t(); ASSERT_EQ(t.n, 4); END_TEST"
    assert not only(ran(tmp_path, test, beside)).failed


def test_two_tests_have_different_names(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="a second test with the name 'a'"):
        ran(tmp_path, "TEST 'a' END_TEST TEST 'a' END_TEST")


def test_a_file_without_a_test_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="no test in this file"):
        ran(tmp_path, "FUNCTION f : INT f := 1; END_FUNCTION")


def test_messages_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="a test cannot call program Mail, whose variable inbox is MESSAGES"):
        ran(
            tmp_path,
            "TEST 'a' VAR p : Mail; END_VAR p(); END_TEST",
            "PROGRAM Mail VAR_INPUT inbox : MESSAGES; END_VAR END_PROGRAM",
        )


def test_assertions_exist_in_tests_only() -> None:
    with pytest.raises(FileInvalid, match="'ASSERT_EQ'"):
        compile_text("PROGRAM p VAR n : INT; END_VAR ASSERT_EQ(n, 1); END_PROGRAM")


def test_a_program_ignores_the_tests_in_its_file() -> None:
    unit = compile_text(
        "PROGRAM p VAR test : INT; END_VAR test := 1; END_PROGRAM TEST 'x' ASSERT_TRUE(nonsense); END_TEST"
    )
    assert [program.name for program in unit.programs] == ["p"]


def test_the_source_of_a_program_does_not_include_files_of_tests(tmp_path: Path) -> None:
    (tmp_path / "pump.st").write_text(PUMP)
    (tmp_path / "pump.test.st").write_text("TEST 'a' END_TEST")
    assert source_files(tmp_path) == (tmp_path / "pump.st",)


def test_a_dialect_applies_to_tests_and_programs(tmp_path: Path) -> None:
    beside = "{attribute 'qualified_only'} VAR_GLOBAL limit : INT := 3; END_VAR"
    (result,) = ran(tmp_path, "TEST 'x' ASSERT_EQ(pump.limit, 3); END_TEST", beside, dialect="codesys")
    assert not result.failed


@pytest.mark.parametrize("kind", ["PROGRAM", "FUNCTION_BLOCK"])
def test_the_steps_of_a_chart_can_be_read(tmp_path: Path, kind: str) -> None:
    chart = f"""{kind} Sequence
    INITIAL_STEP Idle: END_STEP
    STEP Busy: END_STEP
    TRANSITION FROM Idle TO Busy := Idle.T >= T#2s; END_TRANSITION
    TRANSITION FROM Busy TO Idle := FALSE; END_TRANSITION
    END_{kind}
    """
    (result,) = ran(
        tmp_path,
        """TEST 'steps' VAR s : Sequence; END_VAR
        s(); ASSERT_TRUE(s.Idle.X);
        ADVANCE_TIME(T#2s); s();
        ASSERT_FALSE(s.Idle.X); ASSERT_EQ(s.Idle.T, T#2s); ASSERT_TRUE(s.Busy.X);
        END_TEST""",
        chart,
    )
    assert (result.error, result.failed) == ("", [])
