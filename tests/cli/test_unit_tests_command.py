"""`fieldtwin test` with unit tests in Structured Text."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from click.testing import CliRunner, Result

from fieldtwin.cli.test.test_command import command
from fieldtwin.gateway.core.errors import FileInvalid, UsageError

SOURCE = """FUNCTION Clamp : INT
VAR_INPUT x : INT; END_VAR
  IF x > 10 THEN
    Clamp := 10;
  ELSIF x < 0 THEN
    Clamp := 0;
  ELSE
    Clamp := x;
  END_IF
END_FUNCTION
"""


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("plc").mkdir()
    Path("plc/clamp.st").write_text(SOURCE)
    return tmp_path


def run(*arguments: str) -> Result:
    return CliRunner().invoke(command, arguments, standalone_mode=False)


def test_tests_that_pass_end_with_code_0_and_the_coverage(project: Path) -> None:
    Path("plc/clamp.test.st").write_text("TEST 'an upper limit' ASSERT_EQ(Clamp(11), 10); END_TEST")
    done = run()
    assert done.return_value == 0, done.output
    lines = done.output.splitlines()
    assert lines[0].startswith("passed  an upper limit  0 s in ")
    assert lines[-3].split() == ["coverage", "statements", "branches", "transitions", "lines", "not", "executed"]
    assert lines[-2].split() == ["plc/clamp.st", "2/4", "1/3", "6,", "8"]
    assert lines[-1] == "1 passed"


def test_a_failure_names_the_assertion_its_values_and_its_line(project: Path) -> None:
    Path("plc/clamp.test.st").write_text("TEST 'wrong'\n  ASSERT_EQ(Clamp(-1), -1);\nEND_TEST")
    done = run("plc/clamp.test.st")
    assert done.return_value == 1
    said = " ".join(done.output.split())
    assert "1: ASSERT_EQ(Clamp(-1), -1) expected -1 got 0 at 0.000 s, plc/clamp.test.st:2" in said
    assert "fieldtwin test plc/clamp.test.st" in said


def test_a_test_without_an_executed_assertion_is_inconclusive(project: Path) -> None:
    Path("plc/clamp.test.st").write_text("TEST 'empty' IF FALSE THEN ASSERT_TRUE(TRUE); END_IF END_TEST")
    done = run("plc", "--json")
    assert done.return_value == 1
    (result,) = json.loads(done.output)
    assert (result["verdict"], result["reason"]) == ("inconclusive", "the test executed no assertion")
    assert result["checks"][0]["verdict"] == "skipped"


def test_an_error_in_a_scan_is_a_result_and_the_next_test_runs(project: Path) -> None:
    Path("plc/clamp.test.st").write_text(
        "TEST 'a' VAR n : INT; END_VAR\n ASSERT_EQ(1 / n, 0);\nEND_TEST TEST 'b' ASSERT_TRUE(TRUE); END_TEST"
    )
    done = run("plc", "--json")
    assert [(one["verdict"], one["reason"]) for one in json.loads(done.output)] == [
        ("error", "division by zero (plc/clamp.test.st:2)"),
        ("passed", ""),
    ]


def test_cobertura_has_every_line_with_its_branches(project: Path) -> None:
    Path("plc/clamp.test.st").write_text("TEST 'a' ASSERT_EQ(Clamp(11), 10); END_TEST")
    assert run("plc", "--coverage", "coverage.xml").return_value == 0
    root = ET.parse("coverage.xml").getroot()
    assert {
        name: root.get(name) for name in ("lines-covered", "lines-valid", "branches-covered", "branches-valid")
    } == {
        "lines-covered": "2",
        "lines-valid": "4",
        "branches-covered": "1",
        "branches-valid": "3",
    }
    (file,) = root.iter("class")
    assert file.get("filename") == "plc/clamp.st"
    lines = [(line.get("number"), line.get("hits"), line.get("condition-coverage")) for line in file.iter("line")]
    assert lines == [("3", "1", "33% (1/3)"), ("4", "1", None), ("6", "0", None), ("8", "0", None)]


def test_junit_and_html_have_the_tests(project: Path) -> None:
    Path("plc/clamp.test.st").write_text("TEST 'a' ASSERT_EQ(Clamp(11), 9, 'the limit'); END_TEST")
    assert run("plc", "--junit", "j.xml", "--html", "r.html").return_value == 1
    (case,) = ET.parse("j.xml").getroot().iter("testcase")
    assert (case.get("classname"), case.get("name")) == ("fieldtwin.unit test", "a")
    failure = case.find("failure")
    assert failure is not None
    assert failure.get("message") == "1: the limit: ASSERT_EQ(Clamp(11), 9)"
    page = Path("r.html").read_text()
    assert "Executed Structured Text" in page
    assert "branches: ELSE of line 3, THEN 2 of line 3" in page
    assert "Errors on the buses" not in page


def test_unit_tests_run_beside_scenarios(project: Path) -> None:
    Path("plc/clamp.test.st").write_text("TEST 'a' ASSERT_TRUE(TRUE); END_TEST")
    Path("idle.scenario.yaml").write_text(
        "scenario: idle\nsystem: lab_vehicle\nsteps:\n  - wait: {until: \"quality(drive.statusword) == 'good'\", within: 5s}\n"
    )
    done = run(".", "--json")
    assert [one["target"] for one in json.loads(done.output)] == ["virtual", "unit test"], done.output


def test_a_unit_test_has_no_target(project: Path) -> None:
    Path("plc/clamp.test.st").write_text("TEST 'a' ASSERT_TRUE(TRUE); END_TEST")
    done = run("plc/clamp.test.st", "--target", "local")
    assert isinstance(done.exception, UsageError)
    assert "a unit test runs without a system" in str(done.exception)


def test_coverage_needs_a_program_in_structured_text(project: Path) -> None:
    Path("plc/clamp.test.st").write_text("TEST 'a' ASSERT_TRUE(TRUE); END_TEST")
    Path("plc/clamp.st").unlink()
    done = run("plc", "--coverage", "c.xml")
    assert isinstance(done.exception, UsageError)
    assert "--coverage needs programs in Structured Text" in str(done.exception)


def test_a_folder_has_the_tests_in_the_files_of_programs(project: Path) -> None:
    Path("plc/clamp.st").write_text(SOURCE + "TEST 'an upper limit'\n  ASSERT_EQ(Clamp(11), 10);\nEND_TEST\n")
    Path("plc/other.st").write_text("// the TEST 'of nothing' has no END_TEST\nFUNCTION Other : INT END_FUNCTION\n")
    done = run()
    assert done.return_value == 0, done.output
    assert "passed  an upper limit" in done.output
    assert ["plc/clamp.st", "2/4", "1/3", "6,", "8"] in [line.split() for line in done.output.splitlines()]


def test_a_folder_has_the_suites_of_tcunit_in_the_dialects_that_have_them(project: Path) -> None:
    Path("plc/suite.st").write_text("""FUNCTION_BLOCK Suite EXTENDS TcUnit.FB_TestSuite
        TEST('an upper limit'); AssertEquals_INT(10, Clamp(11), ''); TEST_FINISHED();
        END_FUNCTION_BLOCK""")
    done = run("plc", "--dialect", "twincat")
    assert done.return_value == 0, done.output
    assert "passed  an upper limit" in done.output
    assert isinstance(run("plc").exception, UsageError)


def test_a_test_uses_folders_below_its_own_and_the_names_of_libraries(project: Path) -> None:
    Path("plc/lib").mkdir()
    Path("plc/lib/user.st").write_text("FUNCTION Used : INT\nUsed := Tools.Twice(4);\nEND_FUNCTION")
    Path("Tools").mkdir()
    Path("Tools/twice.st").write_text("FUNCTION Twice : INT\nVAR_INPUT a : INT; END_VAR\nTwice := a * 2;\nEND_FUNCTION")
    Path("plc/used.test.st").write_text("TEST 'used' ASSERT_EQ(Used() + Tools.Twice(1), 10); END_TEST")
    done = run("plc", "--dialect", "codesys", "--library", "Tools")
    assert done.return_value == 0, done.output


def test_an_export_with_an_error_is_the_reason_why_its_program_cannot_be_tested(project: Path) -> None:
    Path("plc/plant.xml").write_text("""<project><types><pous><pou name="Main" pouType="program"><interface/><body><FBD>
        <outVariable localId="1"><position x="0" y="0"/><connectionPointIn><connection refLocalId="9"/></connectionPointIn>
        <expression>x</expression></outVariable></FBD></body></pou></pous></types></project>""")
    Path("plc/main.test.st").write_text("TEST 'main' VAR m : Main; END_VAR ASSERT_TRUE(TRUE); END_TEST")
    error = run("plc/main.test.st").exception
    assert isinstance(error, FileInvalid)
    assert "a connection to the element 9, which does not exist" in str(error)
