"""Programs whose declarations are in several files, and the errors that one compilation reports."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from st_bench import program, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc import source_files
from fieldtwin.plc.binding import BoundProgram, load_program
from fieldtwin.plc.cycle.scan import failed
from fieldtwin.plc.runtime.sources import changed, sources
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.program import load_source

MAIN = """PROGRAM main
VAR_INPUT x : INT; END_VAR
VAR_OUTPUT y : INT; END_VAR
VAR f : Filter; END_VAR
f(a := x);
y := f.b + OFFSET;
END_PROGRAM
"""
FILTER = """FUNCTION_BLOCK Filter
VAR_INPUT a : Level; END_VAR
VAR_OUTPUT b : Level; END_VAR
b := quotient(100, a);
END_FUNCTION_BLOCK
"""
LIBRARY = """FUNCTION quotient : INT
VAR_INPUT n, d : INT; END_VAR
quotient := n / d;
END_FUNCTION
VAR_GLOBAL CONSTANT OFFSET : INT := 5; END_VAR
TYPE Level : INT; END_TYPE
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder of a program whose files need each other in both directions of their order."""
    (tmp_path / "plc" / "lib").mkdir(parents=True)
    (tmp_path / "plc" / "a_main.st").write_text(MAIN)
    (tmp_path / "plc" / "b_filter.iecst").write_text(FILTER)
    (tmp_path / "plc" / "lib" / "library.ST").write_text(LIBRARY)
    (tmp_path / "plc" / ".backup.st").write_text("no program at all")
    (tmp_path / "plc" / "notes.txt").write_text("not read")
    return tmp_path / "plc"


def errors_of(path: Path) -> list[str]:
    with pytest.raises(FileInvalid) as caught:
        load_source(path)
    return [str(error).removeprefix(str(path)) for error in (caught.value, *caught.value.others)]


def test_a_folder_is_compiled_as_one_unit(folder: Path) -> None:
    made = load_program("plc", (str(folder.parent),))
    made.x = 20  # type: ignore[attr-defined]
    scan(made)  # type: ignore[arg-type]
    assert made.y == 10  # type: ignore[attr-defined]


def test_a_folder_may_have_xml_files_of_other_tools(folder: Path) -> None:
    (folder / "beremiz.xml").write_text(
        '<?xml version="1.0"?>\n<BeremizRoot URI_location=""><TargetType/></BeremizRoot>'
    )
    assert load_program("plc", (str(folder.parent),))
    (folder / "damaged.xml").write_text('<?xml version="1.0"?>\n<project xmlns="http://www.plcopen.org/xml/tc6_0201">')
    assert errors_of(folder) == ["/damaged.xml:2:54: not XML: no element found"]


def test_an_error_in_a_scan_names_the_file_in_which_it_happened(folder: Path) -> None:
    made = load_source(folder)()
    made.x = 0  # type: ignore[attr-defined]
    with pytest.raises(Exception, match="zero") as caught:
        scan(made)
    reason = failed(BoundProgram("p", made), caught.value)
    assert Path(reason.place).name == "library.ST:3"


def test_every_file_of_a_folder_is_a_source_that_can_change(folder: Path) -> None:
    known = sources([BoundProgram("p", load_source(folder)())])
    assert [Path(source.path).name for source in known] == ["a_main.st", "b_filter.iecst", "library.ST"]
    assert not changed(known)
    (folder / "lib" / "library.ST").write_text(LIBRARY.replace("5", "6"))
    assert [Path(source.path).name for source in changed(known)] == ["library.ST"]


def test_one_compilation_reports_the_errors_of_all_files(folder: Path) -> None:
    (folder / "a_main.st").write_text(MAIN.replace("y := f.b", "z := f.b").replace("x : INT", "x : INTT"))
    (folder / "lib" / "library.ST").write_text(LIBRARY.replace("n / d", "'text'"))
    assert errors_of(folder) == [
        "/a_main.st:2:15: a type 'INTT' is not declared (did you mean 'INT'?)",
        "/a_main.st:6:1: a variable 'z' is not declared",
        "/lib/library.ST:3:13: assigned to quotient; expected INT; got STRING[4]",
    ]


def test_each_pou_with_a_syntax_error_is_reported(folder: Path) -> None:
    (folder / "a_main.st").write_text(
        "PROGRAM a\nx = 1;\nEND_PROGRAM\n\nPROGRAM b\nEND_PROGRAM PROGRAM c\n  y := ;\nEND_PROGRAM"
    )
    (folder / "b_filter.iecst").write_text(
        "TYPE T : (red green); END_TYPE FUNCTION f : INT f := 'END_FUNCTION'; END_FUNCTION"
    )
    assert [error.partition(": ")[0] for error in errors_of(folder)] == [
        "/a_main.st:2:3",
        "/a_main.st:7:8",
        "/b_filter.iecst:1:15",
    ]


def test_errors_of_two_parts_in_one_line_have_their_columns(tmp_path: Path) -> None:
    file = tmp_path / "p.st"
    file.write_text("\nTYPE A : (x y); END_TYPE TYPE B : INT; END_TYPE TYPE C : (x y); END_TYPE")
    assert [error.partition(": ")[0] for error in errors_of(file)] == [":2:13", ":2:61"]


@pytest.mark.long
def test_an_error_in_a_long_file_is_found_in_time_that_grows_with_its_length() -> None:
    types = "\n".join(f"TYPE T{n} : INT; END_TYPE" for n in range(10_000))
    text = "\n" * 700_000 + types + "\n TYPE wrong END_TYPE"
    with pytest.raises(FileInvalid) as caught:
        compile_text(text)
    assert (caught.value.line, caught.value.column, caught.value.others) == (710_001, 13, ())


def test_a_name_with_an_error_is_reported_once(tmp_path: Path) -> None:
    file = tmp_path / "p.st"
    file.write_text(
        "PROGRAM p VAR a : Qqqqq; END_VAR\na := 1; a := 2; b := 1; b := a; END_PROGRAM\nPROGRAM q b := 1; END_PROGRAM"
    )
    assert errors_of(file) == [
        ":1:19: a type 'Qqqqq' is not declared",
        ":2:17: a variable 'b' is not declared",
        ":3:11: a variable 'b' is not declared",
    ]


def test_an_enumeration_with_an_error_is_reported_once(tmp_path: Path) -> None:
    file = tmp_path / "p.st"
    file.write_text("TYPE T : (a, b, a); END_TYPE PROGRAM p VAR x : T; END_VAR x := 1; END_PROGRAM")
    assert errors_of(file) == [":1:6: T has the value a twice"]


def test_a_function_whose_declaration_has_an_error_hides_no_other_error(tmp_path: Path) -> None:
    file = tmp_path / "p.st"
    file.write_text(
        "FUNCTION f : Nowhere f := 1; END_FUNCTION\nFUNCTION g : INT VAR_INPUT a : Absent; END_VAR g := 1; END_FUNCTION\n"
        "PROGRAM p VAR x : INT; END_VAR x := f() + g(1); x := TRUE; END_PROGRAM"
    )
    assert [error.partition(": ")[0] for error in errors_of(file)] == [":1:14", ":2:32", ":3:54"]


def test_a_folder_without_sources_or_with_too_many_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert errors_of(tmp_path) == [
        ": a folder without a program; expected files .st, .iecst, .exp, .xml, .tcpou, .tcdut, .tcgvl, .tcio"
    ]
    monkeypatch.setattr(source_files, "MAX_FILES", 2)
    for n in range(3):
        (tmp_path / f"{n}.st").write_text("")
    assert errors_of(tmp_path) == [": too many files; expected at most 2; got 3"]


@pytest.mark.parametrize(
    ("text", "construct"),
    [
        (
            "PROGRAM p VAR a : DINT; END_VAR a := BITADR(a); END_PROGRAM",
            "addresses as numbers and memory of a controller",
        ),
    ],
)
def test_an_error_names_a_construct_that_is_not_supported(text: str, construct: str) -> None:
    with pytest.raises(FileInvalid, match=f"{construct} are not supported"):
        compile_text(text)


def test_more_errors_than_are_listed_end_the_compilation() -> None:
    statements = "\n".join(f"x{n} := 1;" for n in range(500))
    with pytest.raises(FileInvalid) as caught:
        program(f"PROGRAM p\n{statements}\nEND_PROGRAM")
    assert len(caught.value.others) == FileInvalid.MAX_OTHERS


GOOD, BAD = "x := x + 1;", "x := 'text';"


@given(
    st.lists(
        st.sampled_from([GOOD, BAD, f"IF x > 1 THEN {BAD} END_IF", f"IF x > 1 THEN {GOOD} y := 1; END_IF"]),
        max_size=12,
    )
)
def test_a_statement_is_judged_the_same_whatever_stands_before_it(statements: list[str]) -> None:
    lines = [number for number, text in enumerate(statements, 2) if "'text'" in text]
    undeclared = next((number for number, text in enumerate(statements, 2) if "y :=" in text), None)
    expected = sorted({*lines, *([] if undeclared is None else [undeclared])})
    text = "PROGRAM p VAR x : INT; END_VAR\n" + "\n".join(statements) + "\nEND_PROGRAM"
    try:
        compile_text(text)
        found = []
    except FileInvalid as e:
        found = [error.line for error in (e, *e.others)]
    assert found == expected
