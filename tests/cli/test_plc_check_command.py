"""`fieldtwin plc check`."""

from __future__ import annotations

import json
from pathlib import Path

import click
import pytest
from click.testing import CliRunner, Result

from fieldtwin.cli.plc.check_command import check
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.st.dialects import DIALECTS


def checked(*arguments: str) -> Result:
    return CliRunner().invoke(check, arguments, standalone_mode=False)


def test_a_folder_is_checked_without_a_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plc").mkdir()
    Path("plc/main.st").write_text(
        "PROGRAM p VAR n : Level; END_VAR n := twice(n); END_PROGRAM\nTYPE Level : INT; END_TYPE"
    )
    Path("plc/twice.st").write_text("FUNCTION twice : INT VAR_INPUT n : INT; END_VAR twice := n * 2; END_FUNCTION")
    done = checked("plc")
    assert (done.return_value, done.output) == (0, "2 files, no errors: 1 function, 1 program, 1 type\n")


def test_several_files_and_folders_are_compiled_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lib").mkdir()
    Path("main.st").write_text("PROGRAM p VAR n, spare : Level; END_VAR n := twice(n); END_PROGRAM")
    Path("types.st").write_text("TYPE Level : INT; END_TYPE")
    Path("lib/twice.st").write_text(
        "FUNCTION twice : INT VAR_INPUT n : INT; END_VAR VAR unused : INT; END_VAR twice := n * 2; END_FUNCTION"
    )
    done = checked("main.st", "types.st", "lib", "./lib/twice.st")  # a file that is named twice counts once
    assert done.return_value == 0
    lines = done.output.splitlines()
    assert [line.partition(" ")[0] for line in lines[:-1]] == ["lib/twice.st:1:53:", "main.st:1:18:"]
    assert lines[-1] == "3 files, no errors, 2 warnings: 1 function, 1 program, 1 type"
    Path("types.st").write_text("TYPE Level : INT; END_TYPE FUNCTION f : INT f := TRUE; END_FUNCTION")
    done = checked("main.st", "types.st", "lib")
    assert (done.return_value, done.output.splitlines()[-1]) == (1, "1 error in 1 file")
    assert done.output.startswith("types.st:1:50: assigned to f; expected INT")
    data = json.loads(checked("lib", "types.st", "main.st", "--json").output)
    assert [error["path"] for error in data["errors"]] == ["types.st"]


@pytest.mark.parametrize(
    ("second", "expected"),
    [
        ("missing.st", "no file or folder 'missing.st'; expected files and folders of programs"),
        ("lab_vehicle.yaml", "several sources, and lab_vehicle.yaml is not a program"),
    ],
)
def test_each_of_several_sources_is_a_file_or_folder_of_programs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, second: str, expected: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("p.st").write_text("PROGRAM p END_PROGRAM")
    Path("lab_vehicle.yaml").write_text("fieldtwin: 1\n")
    done = checked("p.st", second)
    assert isinstance(done.exception, UsageError)
    assert expected in str(done.exception)


def test_every_error_has_a_line_and_the_exit_code_is_1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("p.st").write_text("PROGRAM p VAR n : INT; END_VAR\nn := TRUE;\nm := 1;\nEND_PROGRAM")
    done = checked("p.st")
    assert done.return_value == 1
    assert done.output.splitlines() == [
        "p.st:2:6: assigned to n; expected INT; got BOOL (BOOL_TO_INT)",
        "p.st:3:1: a variable 'm' is not declared",
        "2 errors in 1 file",
    ]
    data = json.loads(checked("p.st", "--json").output)
    assert [(error["path"], error["line"], error["column"]) for error in data["errors"]] == [
        ("p.st", 2, 6),
        ("p.st", 3, 1),
    ]


def test_the_programs_of_a_system_are_checked() -> None:
    done = checked("lab_vehicle")
    assert done.output.startswith("1 file, no errors: "), done.output


def test_a_system_of_python_programs_says_so() -> None:
    done = checked("observatory")
    assert isinstance(done.exception, UsageError)
    assert "no program in Structured Text" in str(done.exception)


def test_warnings_of_a_dialect_are_listed_and_become_errors_by_their_ids(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("p.st").write_text("PROGRAM p VAR_INPUT n : INT; END_VAR VAR d : DINT; END_VAR\nn := 1;\nn := d;\nEND_PROGRAM")
    done = checked("p.st", "--dialect", "codesys")
    assert (done.return_value, done.output.splitlines()) == (
        0,
        [
            "p.st:2:1: ST001 n is an input and is assigned to",
            "p.st:3:1: ST001 n is an input and is assigned to",
            "p.st:3:6: ST002 DINT is converted to INT",
            "1 file, no errors, 3 warnings: 1 program",
        ],
    )
    data = json.loads(checked("p.st", "--dialect", "codesys", "--error", "st002", "--json").output)
    assert [error["message"] for error in data["errors"]] == ["ST002 DINT is converted to INT"]
    assert [warning["id"] for warning in data["warnings"]] == ["ST001", "ST001"]
    done = checked("p.st", "--dialect", "codesys", "--error", "all")
    assert (done.return_value, done.output.splitlines()[-1]) == (1, "3 errors in 1 file")


def test_the_choices_of_the_option_are_the_dialects() -> None:
    (option,) = (p for p in check.params if p.name == "dialect")
    assert isinstance(option.type, click.Choice)
    assert list(option.type.choices) == list(DIALECTS)


def test_machine_code_lists_the_statements_that_stay_python(tmp_path: Path) -> None:
    source = tmp_path / "p.st"
    source.write_text(
        "PROGRAM p\nVAR k : INT; s : STRING[9]; END_VAR\n  k := k + 1;\n  s := INT_TO_STRING(k);\n  k := k * 2;\nEND_PROGRAM\n"
    )
    done = checked(str(source), "--machine-code")
    assert done.return_value == 0
    assert f"{source}:4: stays Python: a text" in done.output
    assert "p: machine code for 2 of 3 statements" in done.output
    (program,) = json.loads(checked(str(source), "--machine-code", "--json").output)["machine_code"]
    assert (program["program"], program["statements"], [one["line"] for one in program["stays_python"]]) == (
        "p",
        3,
        [4],
    )
    assert "machine_code" not in json.loads(checked(str(source), "--json").output)
