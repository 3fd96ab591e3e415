"""Calls of programs in the dialects of CODESYS: ``Part();`` executes the PROGRAM Part, which is the only instance of itself."""

from __future__ import annotations

from pathlib import Path

import pytest
from st_bench import program, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.dialects import DIALECTS
from fieldtwin.plc.st.project import compile_source
from fieldtwin.plc.st.unit_tests.suite import load_suite

PART = """PROGRAM Part
VAR_INPUT step : INT := 1; END_VAR
VAR_OUTPUT q : INT; END_VAR
VAR n : INT; delay : TON; END_VAR
ACTION Clear: n := 0; END_ACTION
n := n + step; q := 10 * n;
END_PROGRAM
"""


def test_a_program_that_is_called_keeps_its_variables_which_others_can_read() -> None:
    text = (
        PART
        + "PROGRAM Main VAR_OUTPUT a, b, c : INT; END_VAR Part(); Part(step := 4, q => a); b := Part.n; c := Part.q; END_PROGRAM"
    )
    made = program(text, "Main", "codesys")
    scan(made)
    assert (made.st_body.v_a, made.st_body.v_b, made.st_body.v_c) == (50, 5, 50)
    scan(made, 2)
    assert made.st_body.v_b == 13, "step keeps 4"


def test_all_callers_share_the_program_and_can_call_its_actions() -> None:
    text = f"""{PART} FUNCTION_BLOCK Other Part(); END_FUNCTION_BLOCK
    PROGRAM Main VAR_OUTPUT a, b : INT; END_VAR VAR o : Other; END_VAR
    Part(); o(); a := Part.n; Part.Clear(); b := Part.n; END_PROGRAM"""
    made = program(text, "Main", "twincat")
    scan(made)
    assert (made.st_body.v_a, made.st_body.v_b) == (2, 0)


def test_a_called_program_is_no_program_of_the_system() -> None:
    unit = compile_text(PART + "PROGRAM Main Part(); END_PROGRAM", "", DIALECTS["codesys"])
    assert [one.name for one in unit.programs] == ["Main"]


def test_a_variable_or_an_action_with_the_name_of_a_program_is_not_the_program() -> None:
    text = PART + "PROGRAM Main VAR Part : TON; q : BOOL; END_VAR Part(); q := Part.Q; END_PROGRAM"
    unit = compile_text(text, "", DIALECTS["codesys"])
    assert {one.name for one in unit.programs} == {"Main", "Part"}


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("x := Part.n;", "a variable of Part, a PROGRAM that no POU calls; expected a global variable, or a call Part"),
        ("Part(); Part.n := 3;", "Part cannot be assigned to"),
        ("Part(); x := Part.m;", "in Part, a member 'm' is not declared"),
        ("x := Part();", "a function block is called in a separate statement"),
    ],
)
def test_wrong_uses_of_programs_are_refused(body: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        program(f"{PART} PROGRAM Main VAR x : INT; END_VAR {body} END_PROGRAM", "Main", "codesys")


def test_the_standard_has_no_calls_of_programs() -> None:
    with pytest.raises(FileInvalid, match=r"Part is a PROGRAM and cannot be called.*codesys and twincat"):
        program(f"{PART} PROGRAM Main Part(); END_PROGRAM", "Main")


def test_a_called_program_may_be_in_a_library_and_calls_in_tests_execute_it(tmp_path: Path) -> None:
    library, project = tmp_path / "lib", tmp_path / "project"
    library.mkdir()
    project.mkdir()
    (library / "part.st").write_text(PART)
    (project / "main.st").write_text(
        "PROGRAM Main VAR_OUTPUT a : INT; END_VAR Part(step := 2); a := Part.n; END_PROGRAM"
    )
    unit = compile_source(project, DIALECTS["codesys"], (library,))
    assert [one.name for one in unit.programs] == ["Main"]
    (project / "part.st").write_text(PART)
    test = project / "main.test.st"
    test.write_text("TEST 'calls' VAR m : Main; END_VAR m(); m(); ASSERT_EQ(m.a, 4); END_TEST")
    (result,) = load_suite(test, DIALECTS["codesys"]).run()
    assert (result.error, result.failed, len(result.assertions)) == ("", [], 1)
