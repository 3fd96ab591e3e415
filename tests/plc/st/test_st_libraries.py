"""Libraries of Structured Text, of which a program takes only what it uses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from st_bench import scan

from fieldtwin.cli.plc.check_command import check
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.binding import BoundProgram, load_program
from fieldtwin.plc.runtime.sources import sources
from fieldtwin.plc.st.dialects import dialect_of
from fieldtwin.plc.st.project import compile_source

GOOD = """FUNCTION scaled : INT VAR_INPUT x : INT; END_VAR scaled := limited(x * FACTOR); END_FUNCTION
FUNCTION limited : INT VAR_INPUT x : INT; END_VAR limited := MIN(x, 100); END_FUNCTION
FUNCTION wrong : INT wrong := TRUE; END_FUNCTION
TYPE Colour : (red, green); END_TYPE
PROGRAM demo END_PROGRAM
VAR_GLOBAL CONSTANT FACTOR : INT := 7; END_VAR
"""
BROKEN = """FUNCTION unusable : INT
unusable := ;
END_FUNCTION
FUNCTION usable : INT usable := 11; END_FUNCTION FUNCTION bad : INT bad := TRUE; END_FUNCTION
"""
MAIN = "PROGRAM p VAR n, limited : INT; c : Colour; END_VAR n := scaled(3); c := green; {} END_PROGRAM"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A program in `main.st` and two libraries: one with an error of meaning, one with an error of syntax."""
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "good.st").write_text(GOOD)
    (tmp_path / "lib2").mkdir()
    (tmp_path / "lib2" / "broken.st").write_text(BROKEN)
    (tmp_path / "lib2" / "unused.st").write_text("FUNCTION nothing : INT nothing := 1; END_FUNCTION")
    (tmp_path / "lib2" / "comment.st").write_text("(* a comment that does not end")
    (tmp_path / "main.st").write_text(MAIN.format(""))
    return tmp_path


def loaded(folder: Path) -> Any:
    return load_program("main.st", (str(folder),), libraries=("lib", "lib2"))


def errors_of(folder: Path) -> list[str]:
    with pytest.raises(FileInvalid) as caught:
        loaded(folder)
    return [str(error).removeprefix(str(folder)) for error in (caught.value, *caught.value.others)]


def test_used_declarations_are_taken_and_others_are_not_compiled(folder: Path) -> None:
    made = loaded(folder)
    scan(made)
    assert (made.n, made.c) == (21, 1)


def test_the_files_of_used_declarations_belong_to_the_program(folder: Path) -> None:
    assert [Path(s.path).name for s in sources([BoundProgram("p", loaded(folder))])] == ["main.st", "good.st"]


def test_a_part_beside_a_part_with_a_syntax_error_can_be_used(folder: Path) -> None:
    (folder / "main.st").write_text(MAIN.format("n := usable();"))
    made = loaded(folder)
    scan(made)
    assert made.n == 11


def test_errors_in_used_declarations_are_reported_at_their_place(folder: Path) -> None:
    (folder / "main.st").write_text(MAIN.format("n := unusable();"))
    (error,) = errors_of(folder)
    assert error.startswith("/lib2/broken.st:2:13: not Structured Text")
    (folder / "main.st").write_text(MAIN.format("n := wrong() + bad();"))
    assert [error.partition(": ")[0] for error in errors_of(folder)] == ["/lib/good.st:3:31", "/lib2/broken.st:4:76"]


def test_declarations_of_the_program_have_precedence(folder: Path) -> None:
    (folder / "main.st").write_text(
        MAIN.format("") + " FUNCTION limited : INT VAR_INPUT x : INT; END_VAR limited := -x; END_FUNCTION"
    )
    made = loaded(folder)
    scan(made)
    assert made.n == -21


def test_a_library_that_does_not_exist_is_named(folder: Path) -> None:
    with pytest.raises(FileInvalid, match="absent: cannot read"):
        load_program("main.st", (str(folder),), libraries=("absent",))


def test_the_command_takes_libraries(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(check, ["main.st", "--library", "lib", "--library", "lib2"], standalone_mode=False)
    assert done.output.splitlines() == [
        "main.st:1:18: ST101 limited is not used",
        "2 files, no errors, 1 warning: 2 functions, 1 global variable, 1 program, 1 type",
    ]
    assert CliRunner().invoke(check, ["main.st"], standalone_mode=False).return_value == 1


def test_bases_interfaces_and_what_methods_use_are_taken(tmp_path: Path) -> None:
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "blocks.st").write_text("""INTERFACE Value METHOD Read : INT END_METHOD END_INTERFACE
        CLASS Base IMPLEMENTS Value
          VAR limit : INT; END_VAR
          METHOD PUBLIC Read : INT VAR wrong : INT; END_VAR Read := scaled(3) + wrong; END_METHOD
        END_CLASS
        CLASS Unused METHOD m : INT m := TRUE; END_METHOD END_CLASS""")
    (tmp_path / "lib2").mkdir()
    (tmp_path / "lib2" / "good.st").write_text(GOOD)
    (tmp_path / "main.st").write_text("""
        CLASS Own EXTENDS Base METHOD PUBLIC OVERRIDE Read : INT Read := 1 + SUPER.Read(); END_METHOD END_CLASS
        PROGRAM p VAR o : Own; n : INT; END_VAR n := o.Read(); END_PROGRAM""")
    made = loaded(tmp_path)
    scan(made)
    assert made.n == 22


@pytest.mark.parametrize(
    ("declared", "body", "message"),
    [
        (
            "x : INT;",
            "x := Util.Scaled(3);",
            r"2:6: a variable 'Util' is not declared \(if Util is a library, name its folder",
        ),
        ("", "Util.Log(3);", r"2:1: a variable 'Util' .*libraries: in the system file, or with --library DIR\)"),
        ("x : INT;", "x := Util.limit;", r"2:6: a variable 'Util' .*if Util is a library"),
        ("x : Util.BLINK;", ";", r"1:22: a type 'Util.BLINK' is not declared \(if Util is a library"),
        ("x : INT;", "x := Util.Mode#run;", r"2:6: an enumeration 'Util.Mode' is not declared \(if Util is a library"),
        ("drive : TON;", "drvie.IN := TRUE;", r"2:1: a variable 'drvie' is not declared \(did you mean 'drive'\?\)"),
    ],
)
def test_the_name_of_an_unknown_library_is_an_error_that_says_how_to_declare_it(
    declared: str, body: str, message: str, tmp_path: Path
) -> None:
    source = tmp_path / "main.st"
    source.write_text(f"PROGRAM Main VAR {declared} END_VAR\n{body}\nEND_PROGRAM", encoding="utf-8")
    with pytest.raises(FileInvalid, match=message):
        compile_source(source, dialect_of("codesys"))
    with pytest.raises(FileInvalid) as e:
        compile_source(source)
    assert "library" not in str(e.value)
