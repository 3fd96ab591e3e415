"""Namespaces and USING (IEC 61131-3:2013, 6.9, tables 64 to 66)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from st_bench import program, run, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.binding import load_program
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.syntax.parse import parse_all

PLANT = """
NAMESPACE Plant
  TYPE Mode : (Off, Slow := 3, Fast); Limit : INT(0..50); Point : STRUCT x : INT := 4; END_STRUCT END_TYPE
  FUNCTION Doubled : INT VAR_INPUT a : INT; END_VAR Doubled := 2 * a; END_FUNCTION
  NAMESPACE Drives
    INTERFACE Reading METHOD Read : INT END_METHOD END_INTERFACE
    CLASS Base IMPLEMENTS Reading
      VAR mode : Mode; at : Point; END_VAR
      METHOD PUBLIC Read : INT
        IF mode = Mode#Off THEN mode := Plant.Mode#Fast; END_IF
        Read := Doubled(at.x) + Helper();
      END_METHOD
    END_CLASS
    FUNCTION Helper : INT Helper := Plant.Doubled(10); END_FUNCTION
  END_NAMESPACE
END_NAMESPACE
NAMESPACE Plant.Drives.Motors
  FUNCTION_BLOCK Motor EXTENDS Base
    VAR_OUTPUT n : INT; END_VAR
    n := n + 1;
  END_FUNCTION_BLOCK
END_NAMESPACE
"""


def test_names_are_found_in_the_namespace_and_in_those_around_it() -> None:
    got = run(
        "m : Plant.Drives.Motors.Motor; r : Plant.Drives.Reading; mode : Plant.Mode := Plant.Mode#Slow; "
        "a, b : INT; l : Plant.Limit;",
        "m(); r := m; a := r.Read(); b := Plant.Drives.Helper() + m.n; l := 7;",
        PLANT,
    )
    assert (got["a"], got["b"], got["mode"], got["l"]) == (28, 21, 3, 7)
    assert got["m"].v_mode == 4


@pytest.mark.parametrize(
    "text",
    [
        "USING Plant, Plant.Drives; "
        "PROGRAM Main VAR r : Base; m : Mode; n : INT; END_VAR n := r.Read() + Doubled(1); END_PROGRAM",
        "PROGRAM Main USING Plant; USING Plant.Drives; "
        "VAR r : Base; m : Mode; n : INT; END_VAR n := r.Read() + Doubled(1); END_PROGRAM",
        "NAMESPACE Other USING Plant.Drives; PROGRAM Main USING Plant; "
        "VAR r : Base; m : Mode; n : INT; END_VAR n := r.Read() + Doubled(1); END_PROGRAM END_NAMESPACE",
    ],
)
def test_using_shortens_names_in_a_file_a_pou_and_a_namespace(text: str) -> None:
    made: Any = program(PLANT + text)
    scan(made)
    assert made.n == 30


def test_two_namespaces_may_declare_the_same_names_and_variables_hide_them() -> None:
    got = run(
        "a, b, One : INT;",
        "a := First.Value() * 10 + Second.Value(); One := 5; b := One;",
        """NAMESPACE First FUNCTION Value : INT Value := One(); END_FUNCTION
        FUNCTION One : INT One := 1; END_FUNCTION END_NAMESPACE
        NAMESPACE Second FUNCTION Value : INT VAR One : INT := 7; END_VAR Value := One; END_FUNCTION
        FUNCTION One : INT One := 2; END_FUNCTION END_NAMESPACE""",
    )
    assert (got["a"], got["b"]) == (17, 5)


def test_a_method_hides_a_function_of_its_namespace() -> None:
    text = """NAMESPACE Lib
        FUNCTION Value : INT Value := 1; END_FUNCTION
        CLASS Own METHOD Value : INT Value := 2; END_METHOD METHOD PUBLIC Read : INT Read := Value(); END_METHOD END_CLASS
        CLASS Other METHOD PUBLIC Read : INT Read := Value(); END_METHOD END_CLASS
        END_NAMESPACE"""
    assert run("o : Lib.Own; p : Lib.Other; n : INT;", "n := 10 * o.Read() + p.Read();", text)["n"] == 21


def test_a_namespace_may_be_distributed_over_files(tmp_path: Path) -> None:
    (tmp_path / "a.st").write_text("NAMESPACE Lib CLASS Base VAR PUBLIC n : INT := 3; END_VAR END_CLASS END_NAMESPACE")
    (tmp_path / "b.st").write_text("NAMESPACE Lib CLASS Derived EXTENDS Base END_CLASS END_NAMESPACE")
    (tmp_path / "main.st").write_text("PROGRAM Main USING Lib; VAR d : Derived; n : INT; END_VAR n := d.n; END_PROGRAM")
    made: Any = load_program(str(tmp_path))
    scan(made)
    assert made.n == 3


def test_retained_values_and_inspection_use_the_names_of_variables_only() -> None:
    text = f"{PLANT} PROGRAM Main USING Plant.Drives.Motors; VAR RETAIN m : Motor; END_VAR m(); END_PROGRAM"
    made, restarted = program(text), program(text)
    scan(made)
    assert list(made.internal_names()) == ["m.mode", "m.at.x", "m.n"]
    restarted.restore(made.retained())
    scan(restarted)
    assert restarted.st_body.v_m.v_n == 2


@pytest.mark.parametrize(
    ("text", "place", "message"),
    [
        ("USING Plantt; PROGRAM p END_PROGRAM", "23:7", "a namespace 'Plantt' is not declared"),
        ("PROGRAM p VAR m : Motor; END_VAR END_PROGRAM", "23:19", "a type 'Motor' is not declared"),
        ("PROGRAM p VAR m : Plant.Motor; END_VAR END_PROGRAM", "23:19", r"a type 'Plant\.Motor' is not declared"),
        ("PROGRAM p VAR n : INT; END_VAR n := Helper(); END_PROGRAM", "23:37", "a function 'Helper' is not declared"),
        ("PROGRAM p VAR n : INT; END_VAR n := Plant.Helper(); END_PROGRAM", "23:37", "Plant"),
        (
            "NAMESPACE X CLASS Base END_CLASS END_NAMESPACE "
            "PROGRAM p USING X, Plant.Drives; VAR b : Base; END_VAR END_PROGRAM",
            "23:89",
            r"Base is declared in several namespaces: Plant\.Drives\.Base, X\.Base",
        ),
        ("NAMESPACE Plant CLASS Doubled END_CLASS END_NAMESPACE", "23:23", r"Plant\.Doubled is declared twice"),
        (
            "NAMESPACE X CLASS a EXTENDS b END_CLASS END_NAMESPACE CLASS b END_CLASS CLASS c EXTENDS a END_CLASS",
            "23:89",
            "'a'",
        ),
        ("NAMESPACE X CLASS a", "23:20", "got the end of the file"),
        ("NAMESPACE X VAR n : INT; END_VAR END_NAMESPACE", "23:13", "got VAR"),
        (
            "NAMESPACE X VAR_GLOBAL n : INT; END_VAR END_NAMESPACE PROGRAM p VAR m : INT; END_VAR m := n; END_PROGRAM",
            "23:91",
            "a variable 'n' is not declared",
        ),
    ],
)
def test_an_error_has_its_place(text: str, place: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message) as caught:
        compile_text(PLANT + text)
    assert f"{caught.value.line}:{caught.value.column}" == place


def test_global_variables_of_a_namespace_are_known_inside_it_and_by_their_full_names() -> None:
    text = """NAMESPACE Plant
  VAR_GLOBAL total : INT := 3; END_VAR
  TYPE Kind : (small, large); END_TYPE
  NAMESPACE Drives
    VAR_GLOBAL count : INT; kind : Kind := Kind#large; timer : TON; END_VAR
    VAR_GLOBAL CONSTANT step : INT := 2; END_VAR
    FUNCTION_BLOCK Motor
    VAR_EXTERNAL total : INT; END_VAR
    VAR_OUTPUT n : INT; late : BOOL; END_VAR
    VAR hours : ARRAY[1..step] OF INT; END_VAR
      count := count + total * step; n := count; timer(IN := TRUE, PT := T#20ms); late := timer.Q; hours[2] := n;
    END_FUNCTION_BLOCK
  END_NAMESPACE
END_NAMESPACE
PROGRAM Main
USING Plant.Drives;
VAR m : Motor; seen : INT; count : BOOL; large : BOOL; END_VAR
  m(); seen := Plant.Drives.count; Plant.total := 5; count := m.late; large := kind = Plant.Kind#large;
END_PROGRAM
"""
    made: Any = program(text)
    for number in (1, 2, 3):
        scan(made, number)
    assert (made.seen, made.count, made.large) == (26, True, True)


def test_every_declaration_of_a_namespace_has_its_own_syntax_error() -> None:
    text = """NAMESPACE Plant.Pumps
        USING Plant.Tools;
        TYPE Mode : (Off, On) END_TYPE
        FUNCTION A : INT USING Plant.More; A := LEN('NAMESPACE b') + ; END_FUNCTION
        NAMESPACE Inner
          FUNCTION B : INT B := 1; END_FUNCTION
          FUNCTION C : INT C := := 2; END_FUNCTION
        END_NAMESPACE
        END_NAMESPACE"""
    with pytest.raises(FileInvalid) as caught:
        parse_all(text)
    errors = (caught.value, *caught.value.others)
    assert [(e.line, e.got) for e in errors] == [(3, "END_TYPE"), (4, ";"), (7, ":=")]
