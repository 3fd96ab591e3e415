"""The dialects of Structured Text: what each accepts with which warning, and what the accepted construct computes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from st_bench import scan

from fieldtwin.explain.lookup import explain
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.plc.binding import load_program
from fieldtwin.plc.st.compiler.compile import CompiledUnit, compile_text
from fieldtwin.plc.st.dialects import DIALECTS, FINDINGS, MAX_WARNINGS, WARNINGS, chosen_ids, dialect_of
from fieldtwin.plc.st.program import program_class
from fieldtwin.plc.st.resource import attributes_of
from fieldtwin.plc.st.values import LogicError
from fieldtwin.twin.site.schema import ProgramForm

MODE = "TYPE Mode : (Idle, Run := 5, Fault); END_TYPE\n"
VARIABLES = (
    "VAR_INPUT i : INT := 7; END_VAR VAR r : INT; d : DINT := 70000; u : UINT := 65535; w : WORD := 16#FF01; "
    "x : REAL; l : LREAL := 0.1; m : Mode; a : ARRAY[0..6] OF INT; END_VAR\n"
)


def compiled(body: str, dialect: str) -> CompiledUnit:
    return compile_text(f"{MODE}PROGRAM p {VARIABLES}{body}\nEND_PROGRAM", "p.st", DIALECTS[dialect])


def after(body: str, dialect: str = "codesys") -> dict[str, Any]:
    made = program_class(compiled(body, dialect))()
    scan(made)
    return {name[2:]: value for name, value in attributes_of(made.st_body).items() if name.startswith("v_")}


ACCEPTED = [
    ("ST001", "i := 3; r := i;", "r", 3),
    ("ST002", "r := d;", "r", 70000 - 65536),
    ("ST002", "x := l;", "x", 0.10000000149011612),
    ("ST002", "x := d;", "x", 70000.0),
    ("ST003", "w := w + 16#FF;", "w", 0),
    ("ST003", "w := w / 2;", "w", 0x7F80),
    ("ST003", "d := w;", "d", 0xFF01),
    ("ST004", "r := SHL(i, 14);", "r", -16384),
    ("ST004", "r := -8; r := SHR(r, 1);", "r", -4),
    ("ST004", "r := -32767; r := ROL(r, 1);", "r", 3),
    ("ST005", "r := i AND 5;", "r", 5),
    ("ST005", "r := NOT i;", "r", -8),
    ("ST005", "w := w OR i;", "w", 0xFF07),
    ("ST006", "m := Mode.Run; r := m + 1;", "r", 6),
    ("ST006", "m := 5; r := m;", "r", 5),
    ("ST006", "m := Fault; IF m > 5 THEN r := 1; END_IF", "r", 1),
    ("ST006", "a[5] := 9; m := Run; r := a[m];", "r", 9),
    ("ST008", "d := i - u;", "d", 7 - 65535),
    ("ST008", "IF i < u THEN r := 1; END_IF", "r", 1),
]


@pytest.mark.parametrize(("warning", "body", "name", "expected"), ACCEPTED)
def test_a_vendors_dialect_computes_what_the_standard_refuses(
    warning: str, body: str, name: str, expected: Any
) -> None:
    for dialect in ("codesys", "twincat"):
        assert after(body, dialect)[name] == expected
        assert warning in {found.id for found in compiled(body, dialect).warnings}
    with pytest.raises(FileInvalid):
        compiled(body, "standard")
    if warning in DIALECTS["matiec"].accepts:
        assert after(body, "matiec")[name] == expected
        assert {found.id for found in compiled(body, "matiec").warnings} == {warning}
    else:
        with pytest.raises(FileInvalid):
            compiled(body, "matiec")


@pytest.mark.parametrize(
    ("body", "name", "expected", "bits"),
    [
        ("w := SHL(1, 4);", "w", 16, None),
        ("w := SHR(16#F000, i);", "w", 0x1E0, None),
        ("w := SHL(1, i);", "w", 128, "SHL of the constant 1 has 16 bits here, and may have 8 on a controller"),
        ("w := w AND SHL(1, 8);", "w", 0x100, "SHL of the constant 1 has 16 bits here, and may have 8 on a controller"),
        ("w := ROL(16#81, 1);", "w", 0x102, "ROL of the constant 129 has 16 bits here, and may have 8 on a controller"),
        ("d := SHL(1, 20);", "d", 1 << 20, "SHL of the constant 1 has 32 bits here, and may have 8 on a controller"),
        ("d := d + SHL(1, 9);", "d", 70512, "SHL of the constant 1 has 32 bits here, and may have 8 on a controller"),
        ("d := SHL(1, 9) + d;", "d", 70512, "SHL of the constant 1 has 32 bits here, and may have 8 on a controller"),
        ("r := SHL(-2, 2);", "r", -8, None),
        (
            "r := WORD_TO_INT(SHL(1, 9));",
            "r",
            512,
            "SHL of the constant 1 has 16 bits here, and may have 8 on a controller",
        ),
        ("a[SHL(1, 2)] := 3; r := a[4];", "r", 3, None),
        ("IF SHL(1, 8) = 0 THEN r := 1; END_IF", "r", 1, "SHL of the constant 1 has 8 bits"),
    ],
)
def test_a_shifted_constant_has_the_type_of_its_context(body: str, name: str, expected: int, bits: str | None) -> None:
    """Manuals of CODESYS give it the narrowest type, so a warning names each result that depends on the width."""
    assert after(body)[name] == expected
    assert [found.message for found in compiled(body, "codesys").warnings if found.id == "ST010"] == [bits] * bool(bits)


@pytest.mark.parametrize("dialect", ["standard", "matiec"])
def test_a_shifted_constant_has_the_type_of_its_context_in_the_standard_too(dialect: str) -> None:
    found = after("w := SHL(1, i); d := UDINT_TO_DINT(DWORD_TO_UDINT(SHL(1, 20)));", dialect)
    assert (found["w"], found["d"]) == (128, 1 << 20)
    with pytest.raises(FileInvalid, match="the width of this literal is unknown here"):
        compiled("IF SHL(1, 8) = 0 THEN r := 1; END_IF", dialect)


def test_matiec_shifts_a_constant_as_an_integer() -> None:
    assert after("d := SHL(1, 20);", "matiec")["d"] == 1 << 20
    with pytest.raises(FileInvalid, match="the width of this literal is unknown here"):
        compiled("d := SHL(1, 20);", "standard")


def test_mux_selects_its_last_input_for_a_selector_beyond_it() -> None:
    for dialect in ("codesys", "twincat"):
        assert after("r := MUX(i, 1, 2, 3); d := MUX(9, 5, 6);", dialect)["r"] == 3
        assert after("d := MUX(9, 5, 6);", dialect)["d"] == 6
        with pytest.raises(LogicError, match="an index outside its array"):
            after("r := MUX(-1, 1, 2, 3);", dialect)
    with pytest.raises(LogicError, match="an index outside its array"):
        after("r := MUX(i, 1, 2, 3);", "standard")


def test_a_warning_has_id_file_line_and_column() -> None:
    (found,) = compiled("r := 1;\n  r := d;", "codesys").warnings
    assert str(found) == "p.st:4:8: ST002 DINT is converted to INT"
    assert found.as_data() == {
        "id": "ST002",
        "path": "p.st",
        "line": 4,
        "column": 8,
        "message": "DINT is converted to INT",
    }


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_program_of_the_standard_has_no_warning_in_any_dialect(dialect: str) -> None:
    body = "m := Mode#Run; r := i + 1; w := SHL(w, 1) AND 16#FF; a[w] := 1; l := r; CASE m OF Idle: ; END_CASE"
    assert compiled(body, dialect).warnings == ()


@pytest.mark.parametrize("body", ["r := x;", "r := TRUE;", "r := T#1s;", "m := 4;", "r := 'a';", "IF w THEN END_IF"])
def test_conversions_that_no_dialect_has_are_refused(body: str) -> None:
    for dialect in DIALECTS:
        with pytest.raises(FileInvalid):
            compiled(body, dialect)


def test_a_number_without_a_name_stops_the_task() -> None:
    with pytest.raises(LogicError, match="not a value of Mode; expected 0, 5, 6; got 7"):
        after("m := i;")


def test_values_of_enumerations_are_qualified_by_a_dot() -> None:
    body = "m := Mode.Run; CASE m OF Mode.Idle, Mode.Fault: r := 1; Mode.Run: r := 2; END_CASE"
    assert after(body)["r"] == 2
    assert compiled(body, "codesys").warnings == ()
    with pytest.raises(FileInvalid, match=r"expected Mode#Run \(the dialects codesys and twincat accept the dot\)"):
        compiled("m := Mode.Run;", "standard")
    with pytest.raises(FileInvalid, match=r"in Mode, a value 'Runs' is not declared \(did you mean 'Run'\?\)"):
        compiled("m := Mode.Runs;", "codesys")


def test_an_enumeration_qualifies_its_values_beside_a_variable_of_its_name() -> None:
    text = f"{MODE}PROGRAM p VAR Mode : Mode; END_VAR Mode := Mode.Run; END_PROGRAM"
    made = program_class(compile_text(text, "p.st", DIALECTS["codesys"]))()
    scan(made)
    assert made.st_body.v_mode == 5


def test_global_lists_are_named_by_their_files(tmp_path: Path) -> None:
    (tmp_path / "Limits.st").write_text("VAR_GLOBAL CONSTANT SIZE : INT := Sizes.SIZE + 1; END_VAR")
    (tmp_path / "Sizes.st").write_text(
        "{attribute 'qualified_only'} // of the other list\nVAR_GLOBAL CONSTANT SIZE : INT := 3; END_VAR "
        "VAR_GLOBAL level : INT := 8; END_VAR"
    )
    (tmp_path / "main.st").write_text(
        "PROGRAM p VAR a : ARRAY[1..Limits.SIZE] OF INT; n, level : INT; END_VAR "
        "level := 2; Sizes.level := Sizes.level + 1; a[4] := SIZE; n := a[4] * 10 + Sizes.level; END_PROGRAM"
    )
    made: Any = load_program(str(tmp_path), dialect="twincat")
    scan(made)
    assert made.n == 49
    with pytest.raises(FileInvalid, match="'Sizes' is not declared"):
        load_program(str(tmp_path))


def test_a_name_in_two_global_lists_has_to_be_qualified(tmp_path: Path) -> None:
    for name in ("A", "B"):
        (tmp_path / f"{name}.st").write_text("VAR_GLOBAL x : INT; END_VAR")
    (tmp_path / "main.st").write_text("PROGRAM p VAR n : INT; END_VAR n := A.x;\nn := x;\nn := B.y; END_PROGRAM")
    with pytest.raises(
        FileInvalid, match=r"main.st:2:6: x is a variable of several global lists; expected a.x, b.x"
    ) as e:
        load_program(str(tmp_path), dialect="codesys")
    assert ["in B, a variable 'y' is not declared" in str(other) for other in e.value.others] == [True]


@pytest.mark.parametrize(
    ("pragma", "codesys", "matiec"),
    [
        ("{attribute 'hide'}", [], ["ST007"]),
        ("{ Attribute  'Qualified_Only' }", [], ["ST007"]),
        ("{attribute 'pack_mode' := '1'}", [], ["ST007"]),
        ("{attribute 'TcRpcEnable' := '1'}", [], ["ST007"]),
        ("{attribute 'OPC.UA.DA.Access' := '1'}", [], ["ST007"]),
        ("{region 'inputs'}", [], ["ST007"]),
        ("{warning disable C0195}", [], ["ST007"]),
        ("{attribute 'hied'}", ["ST007"], ["ST007"]),
        ("{attribute hide}", ["ST007"], ["ST007"]),
        ("{attribute 'call_after_init'}", ["ST007"], ["ST007"]),
        ("{attribute 'TcInitOnReset'}", ["ST007"], ["ST007"]),
        ("{disable code generation}", ["ST007"], ["ST007"]),
        ("{{ int x = 1; }}", None, ["ST007"]),
        ("{IF defined (SIM)}", None, None),
        ("{not closed", None, None),
    ],
)
def test_pragmas_are_skipped_with_a_warning_or_refused(
    pragma: str, codesys: list[str] | None, matiec: list[str] | None
) -> None:
    for dialect, expected in (("codesys", codesys), ("twincat", codesys), ("matiec", matiec)):
        if expected is None:
            with pytest.raises(FileInvalid, match=r"p.st:3:1: "):
                compiled(f"{pragma}\nr := 1;", dialect)
        else:
            assert [warning.id for warning in compiled(f"{pragma}\nr := 1;", dialect).warnings] == expected


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("DATE_TO_DWORD(D#1970-01-02)", 86_400),
        ("DT_TO_DWORD(DT#1970-01-01-00:01:05)", 65),
        ("TOD_TO_DWORD(TOD#00:00:02)", 2_000),
        ("DT_TO_DWORD(DWORD_TO_DT(77))", 77),
        ("DATE_TO_DWORD(DWORD_TO_DATE(86_405))", 86_400),
        ("TOD_TO_DWORD(DWORD_TO_TOD(86_400_500))", 500),
    ],
)
def test_dates_convert_to_numbers_of_seconds_in_a_vendors_dialect(expression: str, expected: int) -> None:
    text = f"PROGRAM p VAR d : DWORD; END_VAR d := {expression}; END_PROGRAM"
    made = program_class(compile_text(text, "p.st", DIALECTS["codesys"]))()
    scan(made)
    assert made.st_body.v_d == expected
    with pytest.raises(FileInvalid, match="there is no conversion"):
        compile_text(text)


@given(st.integers(-(2**15), 2**15 - 1), st.integers(0, 40))
def test_shifts_of_integers_equal_those_of_two_s_complement(number: int, count: int) -> None:
    held = after(f"r := {number}; r := SHR(r, {count}); d := {number}; u := {number & 0xFFFF}; u := SHL(u, {count});")
    assert held["r"] == number >> count
    assert held["u"] == (number & 0xFFFF) << count & 0xFFFF


def test_ids_are_chosen_by_name() -> None:
    assert chosen_ids(["st001", "ST002"]) == {"ST001", "ST002"}
    assert chosen_ids(["all"]) == {*WARNINGS, *FINDINGS}
    with pytest.raises(UsageError, match="an unknown warning; expected all, ST001"):
        chosen_ids(["E1"])
    with pytest.raises(UsageError, match="did you mean 'codesys'"):
        dialect_of("codesis")


def test_every_warning_is_explained() -> None:
    assert [explain(id)[0].title for id in WARNINGS] == list(WARNINGS.values())


def test_the_system_file_knows_every_dialect() -> None:
    assert [ProgramForm(source="a.st", dialect=name).dialect for name in DIALECTS] == list(DIALECTS)  # type: ignore[arg-type]


def test_many_warnings_of_one_id_hide_no_other_and_say_that_there_are_more() -> None:
    found = compiled("\n".join([*["r := d;"] * (MAX_WARNINGS + 1), "i := 3;"]), "codesys").warnings
    assert [w.id for w in found] == [*["ST002"] * MAX_WARNINGS, "ST001"]
    assert found[-2].message.endswith("further warnings ST002 are not listed")
    assert "further" not in found[-3].message


LAMP = """FUNCTION_BLOCK Blink
VAR_INPUT on : BOOL; n : INT := 4; END_VAR
VAR_OUTPUT lit : BOOL; count : INT; END_VAR
  lit := on; count := count + n;
END_FUNCTION_BLOCK
PROGRAM p VAR b : Blink; s, r, i : INT; x, y : BOOL; END_VAR
"""


def last_of(body: str, dialect: str, scans: int = 1) -> dict[str, Any]:
    made = program_class(compile_text(f"{LAMP}{body}\nEND_PROGRAM", "p.st", DIALECTS[dialect]))()
    for _ in range(scans):
        scan(made)
    return {name[2:]: value for name, value in attributes_of(made.st_body).items() if name.startswith("v_")}


EMPTY_OR_LATCHED = [
    # The help of CODESYS, "Assignment Operator S=": a TRUE operand sets the variable, which then keeps its value.
    ("x S= i < 1; i := i + 1;", "x", True),
    ("x := TRUE; x R= i > 5;", "x", True),
    ("x := i = 0; x R= i = 2; i := i + 1;", "x", False),
    # An empty argument of a block leaves its input at the value of the last call, or at its initial value.
    ("b(on := TRUE, n := , lit => x, count => );  s := b.count;", "s", 12),
    ("b(on := TRUE, lit => x,); s := b.count;", "s", 12),
    ("b(on := , n := 1); s := b.count; x := b.lit;", "s", 3),
]


@pytest.mark.parametrize(("body", "name", "expected"), EMPTY_OR_LATCHED)
def test_vendors_calls_have_empty_arguments_and_statements_set_and_reset(body: str, name: str, expected: Any) -> None:
    for dialect in ("codesys", "twincat"):
        assert last_of(body, dialect, scans=3)[name] == expected
    for dialect in ("standard", "matiec"):
        with pytest.raises(FileInvalid, match=r"an empty argument of b|[SR]= is not in this dialect"):
            last_of(body, dialect)


def test_variables_may_have_the_names_s_and_r() -> None:
    assert last_of("s := 3; r := 4; IF r = 4 AND s= 3 THEN i := s; END_IF", "codesys")["i"] == 3


def test_a_semicolon_may_follow_the_result_of_a_function() -> None:
    twice = "FUNCTION Twice : INT; VAR_INPUT n : INT; END_VAR Twice := 2 * n; END_FUNCTION\n"
    text = f"{twice}PROGRAM p VAR r : INT; END_VAR\nr := Twice(4); END_PROGRAM"
    made = program_class(compile_text(text, "p.st", DIALECTS["twincat"]))()
    scan(made)
    assert attributes_of(made.st_body)["v_r"] == 8


BISTABLES = """PROGRAM p VAR a, b : BOOL; s : SR; r : RS; up : CTU; down : CTD_DINT; both : CTUD; n : INT; l : DINT; END_VAR
s(SET1 := TRUE, RESET := TRUE, Q1 => a); r(SET := TRUE, RESET1 := TRUE, Q1 => b);
up(CU := TRUE, RESET := FALSE, PV := 1); up.RESET := up.Q; up(); down(CD := FALSE, LOAD := TRUE, PV := 7, CV => l);
both(LOAD := TRUE, RESET := FALSE, PV := 5, CV => n); END_PROGRAM
"""


@pytest.mark.parametrize("dialect", ["codesys", "twincat"])
def test_inputs_of_standard_blocks_have_the_names_of_the_library_of_the_tool(dialect: str) -> None:
    """Sources: the libraries Standard of CODESYS and Tc2_Standard of TwinCAT."""
    made: Any = program_class(compile_text(BISTABLES, "p.st", DIALECTS[dialect]))()
    scan(made)
    body = made.st_body
    assert (body.v_a, body.v_b, body.v_up.R, body.v_up.CV, body.v_l, body.v_n) == (True, False, True, 0, 7, 5)
    with pytest.raises(FileInvalid, match="in SR, a parameter 'SET1' is not declared"):
        compile_text(BISTABLES, "p.st", DIALECTS["standard"])
    with pytest.raises(FileInvalid, match="parameter S1 of SR is given twice"):
        compile_text(BISTABLES.replace("SET1 := TRUE", "SET1 := TRUE, S1 := TRUE"), "p.st", DIALECTS[dialect])
