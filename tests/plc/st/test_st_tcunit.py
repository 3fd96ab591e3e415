"""Test suites in the form of TcUnit (https://tcunit.org), with the names and the order of the parameters of its documentation."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.dialects import dialect_of
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
        ("TEST('x'); AssertArrayEquals_INT(1, 1, '');", "AssertArrayEquals_INT is not supported"),
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
