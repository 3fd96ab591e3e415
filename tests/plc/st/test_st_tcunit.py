"""Test suites in the form of TcUnit (https://tcunit.org), with the names and the order of the parameters of its documentation."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.dialects import dialect_of
from fieldtwin.plc.st.project import compile_source
from fieldtwin.plc.st.unit_tests.run import TestResult
from fieldtwin.plc.st.unit_tests.suite import load_suite

RAMP = """FUNCTION_BLOCK FB_Ramp
VAR_INPUT target : REAL; END_VAR
VAR_OUTPUT value : REAL; done : BOOL; END_VAR
VAR t : TON; END_VAR
t(IN := TRUE, PT := T#2s);
IF t.Q THEN value := target; done := TRUE; ELSE value := target / 2.0; END_IF
END_FUNCTION_BLOCK
"""


def ran(folder: Path, methods: str, calls: str = "One();", variables: str = "") -> list[TestResult]:
    (folder / "ramp.st").write_text(RAMP)
    path = folder / "suite.st"
    path.write_text(
        f"FUNCTION_BLOCK FB_Ramp_Test EXTENDS TcUnit.FB_TestSuite\nVAR ramp : FB_Ramp; {variables} END_VAR\n{calls}\n{methods}\n"
        "END_FUNCTION_BLOCK"
    )
    return list(load_suite(path, dialect_of("twincat")).run())


def test_a_test_ends_in_the_cycle_that_calls_test_finished(tmp_path: Path) -> None:
    first, second = ran(
        tmp_path,
        """METHOD One
        TEST('begins at half');
        ramp(target := 8.0);
        AssertEquals(Expected := 4.0, Actual := ramp.value, Message := 'half');
        AssertFalse(Condition := ramp.done, Message := 'not done');
        TEST_FINISHED();
        END_METHOD
        METHOD Two
        TEST('ends');
        IF ramp.done THEN AssertEquals(9.0, ramp.value, 'wrong'); TEST_FINISHED(); END_IF
        END_METHOD""",
        "One(); Two();",
    )
    assert (first.test.name, first.error, [one.failed for one in first.assertions]) == (
        "begins at half",
        "",
        [False, False],
    )
    assert [one.executed for one in first.assertions] == [1, 1]  # the assertions after the end of the test do not count
    (failed,) = second.assertions
    assert (second.test.name, second.simulated_ns) == ("ends", 2_000_000_000)
    assert (failed.failed, failed.expected, failed.got, failed.t_ns) == (True, "9.0", "8.0", 2_000_000_000)
    assert (failed.text.text, failed.text.message) == ("AssertEquals(9.0, ramp.value)", "wrong")


@pytest.mark.parametrize(
    ("assertion", "failed"),
    [
        ("AssertTrue(TRUE, '');", False),
        ("AssertTrue(FALSE, '');", True),
        ("AssertEquals_REAL(Expected := 1.0, Actual := 1.25, Delta := 0.25, Message := '');", False),
        ("AssertEquals_REAL(1.0, 1.25, 0.125, '');", True),
        ("AssertEquals_INT(Actual := 5, Expected := 5, Message := '');", False),
        ("AssertEquals_STRING('on', 'off', 'text');", True),
        ("THIS^.AssertEquals_TIME(T#1s, T#1000ms, '');", False),
    ],
)
def test_assertions(tmp_path: Path, assertion: str, failed: bool) -> None:
    (result,) = ran(tmp_path, f"METHOD One\nTEST('x'); {assertion} TEST_FINISHED();\nEND_METHOD")
    assert [one.failed for one in result.assertions] == [failed]


def test_a_test_that_does_not_end_is_an_error(tmp_path: Path) -> None:
    (result,) = ran(tmp_path, "METHOD One\nTEST('x'); AssertTrue(TRUE, '');\nEND_METHOD")
    assert result.error == "it did not call TEST_FINISHED within T#10m"
    assert result.error_place == (str(tmp_path / "suite.st"), 5)


def test_an_error_in_a_cycle_is_an_error_of_the_tests_that_have_not_ended(tmp_path: Path) -> None:
    first, second = ran(
        tmp_path,
        "METHOD One\nTEST('a'); AssertTrue(TRUE, ''); TEST_FINISHED(); TEST('b');\nzero := 1 / zero;\nEND_METHOD",
        variables="zero : INT;",
    )
    assert (first.error, second.error) == ("", "division by zero")
    assert second.error_place == (str(tmp_path / "suite.st"), 6)


def test_a_test_can_be_ended_by_its_name(tmp_path: Path) -> None:
    results = ran(tmp_path, "METHOD One\nTEST('a'); TEST('b'); TEST_FINISHED(); TEST_FINISHED_NAMED('a');\nEND_METHOD")
    assert [(one.test.name, one.error) for one in results] == [("a", ""), ("b", "")]


@pytest.mark.parametrize(
    ("body", "error"),
    [
        ("AssertTrue(TRUE, '');", "AssertTrue before a test has begun"),
        ("TEST('x'); AssertArrayEquals_INT(1, 1, '');", "an assertion about arrays"),
        ("TEST('x'); AssertEquals(1);", "AssertEquals lacks ACTUAL"),
        ("TEST(5);", "the name in TEST"),
        ("TEST_FINISHED_NAMED('y');", "a test 'y' has not begun"),
    ],
)
def test_errors_of_suites_have_their_place(tmp_path: Path, body: str, error: str) -> None:
    with pytest.raises(FileInvalid) as raised:
        ran(tmp_path, f"METHOD One\n{body}\nEND_METHOD")
    assert error in raised.value.message
    assert raised.value.line == 5


def test_a_suite_of_a_twincat_project(tmp_path: Path) -> None:
    (tmp_path / "ramp.st").write_text(RAMP)
    path = tmp_path / "FB_Ramp_Test.TcPOU"
    path.write_text(
        """<?xml version="1.0" encoding="utf-8"?>
<TcPlcObject Version="1.1.0.1"><POU Name="FB_Ramp_Test" Id="{1}" SpecialFunc="None">
<Declaration><![CDATA[FUNCTION_BLOCK FB_Ramp_Test EXTENDS TcUnit.FB_TestSuite
VAR ramp : FB_Ramp; END_VAR]]></Declaration>
<Implementation><ST><![CDATA[One();]]></ST></Implementation>
<Method Name="One" Id="{2}"><Declaration><![CDATA[METHOD One]]></Declaration>
<Implementation><ST><![CDATA[TEST('half');
ramp(target := 8.0);
AssertEquals(Expected := 4.0, Actual := ramp.value, Message := 'half');
TEST_FINISHED();]]></ST></Implementation></Method>
</POU></TcPlcObject>"""
    )
    (result,) = load_suite(path, dialect_of("twincat")).run()
    assert (result.test.name, result.error, [one.failed for one in result.assertions]) == ("half", "", [False])


ARRAYS = "a : ARRAY[1..3] OF INT := [1, 2, 3]; b : ARRAY[0..2] OF INT := [1, 2, 3]; c : ARRAY[1..2] OF INT; \
r : ARRAY[1..2, 0..1] OF LREAL := [1.0, 2.0, 3.0, 4.0]; s : ARRAY[1..2, 0..1] OF LREAL := [1.0, 2.0, 3.5, 4.0];"


@pytest.mark.parametrize(
    ("assertion", "expected", "got"),
    [
        ("AssertArrayEquals_INT(Expecteds := a, Actuals := b, Message := 'same');", "", ""),
        ("b[2] := 7; AssertArrayEquals_INT(a, b, 'x'); b[2] := 3;", "3 in element [2]", "7"),
        ("AssertArrayEquals_INT(a, c, 'x');", "3 elements", "2 elements"),
        ("AssertArray2dEquals_LREAL(Expecteds := r, Actuals := s, Delta := 0.5, Message := '');", "", ""),
        ("AssertArray2dEquals_LREAL(r, s, 0.25, '');", "3.0 within 0.25 in element [2,0]", "3.5"),
    ],
)
def test_arrays_are_compared_by_element(tmp_path: Path, assertion: str, expected: str, got: str) -> None:
    (result,) = ran(tmp_path, f"METHOD One\nTEST('x'); {assertion} TEST_FINISHED();\nEND_METHOD", variables=ARRAYS)
    assert result.error == ""
    (one,) = result.assertions
    assert (one.executed, one.failed, one.expected, one.got) == (1, bool(got), expected, got)


@pytest.mark.parametrize(
    "assertion",
    ["AssertArrayEquals_INT(a, 3, 'x');", "AssertArrayEquals_INT(a, ramp, 'x');", "AssertArrayEquals_INT(a, r, 'x');"],
)
def test_an_assertion_about_arrays_needs_arrays_of_one_type(tmp_path: Path, assertion: str) -> None:
    with pytest.raises(FileInvalid, match="array"):
        ran(tmp_path, f"METHOD One\nTEST('x'); {assertion} TEST_FINISHED();\nEND_METHOD", variables=ARRAYS)


def test_ordered_tests_run_one_after_the_other(tmp_path: Path) -> None:
    first, second = ran(
        tmp_path,
        """METHOD One
        IF TEST_ORDERED('first') THEN
          n := n + 1;
          IF n = 5 THEN AssertEquals(5, n, ''); TEST_FINISHED(); END_IF
        END_IF
        END_METHOD
        METHOD Two
        IF TEST_ORDERED('second') THEN
          AssertEquals(5, n, 'after the first');
          TEST_FINISHED();
        END_IF
        END_METHOD""",
        "One(); Two();",
        "n : INT;",
    )
    assert [(one.test.name, one.error, len(one.failed)) for one in (first, second)] == [
        ("first", "", 0),
        ("second", "", 0),
    ]
    assert [one.executed for one in (*first.assertions, *second.assertions)] == [1, 1]


def test_an_ordered_test_is_an_if_of_its_own(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="TEST_ORDERED"):
        ran(tmp_path, "METHOD One\nIF TEST_ORDERED('x') AND TRUE THEN TEST_FINISHED(); END_IF\nEND_METHOD")


def test_the_source_of_a_program_may_have_suites(tmp_path: Path) -> None:
    (tmp_path / "ramp.st").write_text(RAMP + "PROGRAM MAIN VAR ramp : FB_Ramp; END_VAR ramp(); END_PROGRAM")
    (tmp_path / "suite.st").write_text(
        "FUNCTION_BLOCK Suite EXTENDS TcUnit.FB_TestSuite TEST('x'); TEST_FINISHED(); END_FUNCTION_BLOCK\n"
        "FUNCTION_BLOCK More EXTENDS Suite END_FUNCTION_BLOCK\n"
        "PROGRAM PRG_TEST VAR suite : More; END_VAR TcUnit.RUN(); END_PROGRAM"
    )
    made = compile_source(tmp_path, dialect_of("twincat"))
    assert [program.name for program in made.programs] == ["MAIN"]
    assert [one.name for one in made.missing] == ["Suite", "More", "PRG_TEST"]
    (tmp_path / "other.st").write_text("PROGRAM Other VAR s : Sute; t : Suite; END_VAR t(); END_PROGRAM")
    with pytest.raises(FileInvalid, match="a type 'Sute' is not declared"):
        compile_source(tmp_path / "other.st", dialect_of("twincat"))


def test_suites_are_compiled_with_the_library_that_declares_their_base(tmp_path: Path) -> None:
    (tmp_path / "suite.st").write_text("PROGRAM MAIN VAR s : Suite; END_VAR s(); END_PROGRAM\n"
        "FUNCTION_BLOCK Suite EXTENDS TcUnit.FB_TestSuite END_FUNCTION_BLOCK")  # fmt: skip
    (tmp_path / "TcUnit").mkdir()
    (tmp_path / "TcUnit" / "base.st").write_text("FUNCTION_BLOCK FB_TestSuite END_FUNCTION_BLOCK")
    made = compile_source(tmp_path / "suite.st", dialect_of("twincat"), (tmp_path / "TcUnit",))
    assert [program.name for program in made.programs] == ["MAIN"]
