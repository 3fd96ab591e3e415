"""Located variables: VAR_GLOBAL with addresses, and addresses in statements (IEC 61131-3:2013, 6.5.5 and table 16).

A program offers the located variables that it uses as inputs (%I), outputs (%Q) and locals (%M). The areas are those of OpenPLC:
an address of one size is a different variable from an address of another size.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from st_bench import program, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.image.image import INPUTS, TagKind
from fieldtwin.gateway.core.values import Quality, TagValue
from fieldtwin.plc.binding import InputBinding, image_for, load_program
from fieldtwin.plc.program import Role, ScanInfo
from fieldtwin.plc.runtime.config import PlcConfig, ProgramConfig
from fieldtwin.plc.runtime.runner import TaskRunner
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.dialects import dialect_of
from fieldtwin.plc.st.findings.find import findings
from fieldtwin.plc.st.syntax.parse import parse_all

GLOBALS = """VAR_GLOBAL
  start AT %IX0.0 : BOOL;
  lamp  AT %QX0.0 : BOOL;
  level AT %MW3   : INT := 5;
  spare AT %QX0.7 : BOOL;
END_VAR
"""


def roles(made: Any) -> dict[str, tuple[Role, str]]:
    return {v.name: (v.role, v.address) for v in made.variables.values()}


def test_a_program_offers_the_located_globals_that_it_uses_and_those_that_no_program_uses() -> None:
    made: Any = program(
        GLOBALS
        + """FUNCTION_BLOCK Count VAR_EXTERNAL level : INT; END_VAR level := level + 1; END_FUNCTION_BLOCK
PROGRAM p
  VAR_EXTERNAL start, lamp : BOOL; END_VAR
  VAR count : Count; END_VAR
  lamp := start; IF start THEN count(); END_IF
END_PROGRAM"""
    )
    assert roles(made) == {
        "start": (Role.INPUT, "%IX0.0"),
        "lamp": (Role.OUTPUT, "%QX0.0"),
        "level": (Role.LOCAL, "%MW3"),
        "spare": (Role.OUTPUT, "%QX0.7"),
    }
    scan(made)
    assert (made.lamp, made.level) == (False, 5)
    made.start = True
    scan(made)
    assert (made.lamp, made.level) == (True, 6)


def test_an_address_in_a_statement_is_a_variable_of_the_type_of_its_size() -> None:
    made: Any = program(
        "PROGRAM p VAR b : BOOL; y : BYTE; w : WORD; d : DWORD; l : LWORD; END_VAR\n"
        "b := %IX0.1; y := %IB2; w := %IW3; d := %ID4; l := %IL5; %Q0.2 := b; %QW7 := w; %MD8 := d; END_PROGRAM"
    )
    assert roles(made).keys() >= {"IX0_1", "IB2", "IW3", "ID4", "IL5", "QX0_2", "QW7", "MD8"}
    assert made.variables["IX0_1"].kind is TagKind.BOOL
    assert (made.variables["QX0_2"].role, made.variables["QX0_2"].address) == (Role.OUTPUT, "%QX0.2")
    made.IX0_1, made.IW3, made.ID4 = True, 0xFFFF, 70_000
    scan(made)
    assert (made.QX0_2, made.QW7, made.MD8) == (True, 0xFFFF, 70_000)


def test_a_value_that_does_not_fit_the_size_of_its_address_is_refused() -> None:
    with pytest.raises(FileInvalid, match="2:9: assigned to %QW7; expected WORD; got DWORD"):
        program("PROGRAM p VAR d : DWORD; END_VAR\n%QW7 := d; END_PROGRAM")


@pytest.mark.parametrize("declared", ["PROGRAM p VAR lamp AT %QX0.0 : BOOL; END_VAR", GLOBALS + "PROGRAM p"])
def test_an_address_and_the_variable_that_is_declared_there_are_the_same(declared: str) -> None:
    made: Any = program(f"{declared}\n%Q0.0 := TRUE; %QX0.1 := lamp; END_PROGRAM")
    assert set(roles(made)) - {"start", "level", "spare"} == {"lamp", "QX0_1"}
    scan(made)
    assert (made.lamp, made.QX0_1) == (True, True)


def test_a_global_that_a_different_program_uses_is_not_offered() -> None:
    text = GLOBALS + "PROGRAM a lamp := level > 3; END_PROGRAM PROGRAM b VAR n : INT; END_VAR n := n + 1; END_PROGRAM"
    assert set(roles(program(text, "a"))) == {"lamp", "level", "start", "spare"}
    assert set(roles(program(text, "b"))) == {"n", "start", "spare"}


@pytest.mark.parametrize("declared", ["AT %QX0.7 : BOOL", "AT %MW3 : STRING", "AT %QX0.7 : ARRAY[1..2] OF BOOL"])
def test_an_unused_global_that_a_program_cannot_offer_is_no_error(declared: str) -> None:
    text = f"VAR_GLOBAL tag {declared}; END_VAR PROGRAM p VAR tag, QX0_7 : INT; END_VAR tag := QX0_7; END_PROGRAM"
    assert set(roles(program(text))) == {"tag", "QX0_7"}


def test_programs_that_declare_one_address_share_the_variable() -> None:
    text = """PROGRAM a VAR out AT %MW0 : INT; END_VAR out := out + 1; END_PROGRAM
PROGRAM b VAR got AT %MW0 : INT; copy AT %QW0 : INT; END_VAR copy := got; END_PROGRAM"""
    together: dict[Any, Any] = {}
    a, b = (type(program(text, name))(together) for name in "ab")  # type: ignore[call-arg]
    for number in (1, 2, 3):
        a.execute(ScanInfo(number, number, number == 1))
    b.execute(ScanInfo(4, 1, True))
    assert (a.out, b.got, b.copy) == (3, 3, 3)  # type: ignore[attr-defined]


def test_one_address_with_two_types_is_refused() -> None:
    text = "PROGRAM a VAR x AT %MW0 : INT; END_VAR END_PROGRAM\nPROGRAM b VAR y AT %MW0 : UINT; END_VAR END_PROGRAM"
    with pytest.raises(FileInvalid, match="2:15: y is declared with another type; expected INT"):
        program(text, "a")


def test_addresses_of_different_sizes_are_different_variables() -> None:
    made: Any = program("PROGRAM p %QX0.0 := TRUE; %MW0 := %QW0; END_PROGRAM")
    scan(made)
    assert (made.QX0_0, made.QW0, made.MW0) == (True, 0, 0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("PROGRAM p\n%IX0.0 := TRUE; END_PROGRAM", "2:1: %IX0.0 cannot be assigned to"),
        (GLOBALS + "PROGRAM p\nstart := TRUE; END_PROGRAM", "8:1: start cannot be assigned to"),
        ("PROGRAM p\n%QX0.0 := %I*; END_PROGRAM", "2:11: an address without a number is allowed in a declaration only"),
        ("VAR_GLOBAL a AT %QW0 : INT; b AT %QW0 : INT; END_VAR PROGRAM p END_PROGRAM", "b and a have one address"),
        ("VAR_GLOBAL a AT %QW0 : STRING; END_VAR PROGRAM p\na := 'x'; END_PROGRAM", "1:12: a cannot be bound to a tag"),
    ],
)
def test_mistakes_with_addresses_are_refused(text: str, said: str) -> None:
    with pytest.raises(FileInvalid, match=said.replace("*", "[*]")):
        program(text)


def test_the_dialect_of_matiec_warns_about_an_assignment_to_an_input_address() -> None:
    unit = compile_text("PROGRAM p\n%IX0.0 := TRUE; END_PROGRAM", dialect=dialect_of("matiec"))
    assert [str(w) for w in unit.warnings] == [":2:1: ST001 %IX0.0 is an input and is assigned to"]


def test_the_quality_of_a_located_global_input_is_known() -> None:
    made: Any = program(GLOBALS + "PROGRAM p VAR good : BOOL; END_VAR good := IS_GOOD(start); END_PROGRAM")
    for quality in (Quality.GOOD, Quality.BAD):
        made._lookup = lambda name, quality=quality: {"start": TagValue(True, quality)}[name]
        scan(made)
        assert made.good is (quality is Quality.GOOD)


def test_the_line_that_wrote_a_located_global_is_known() -> None:
    made: Any = program(
        GLOBALS + "FUNCTION_BLOCK F\nlamp := TRUE; END_FUNCTION_BLOCK\nPROGRAM p VAR f : F; END_VAR f(); END_PROGRAM"
    )
    assert made.last_assignment("lamp")[0] is None
    scan(made)
    assert made.last_assignment("lamp")[0].line == 8
    made.put("lamp", False)
    assert made.last_assignment("lamp")[0] is None


def test_a_retained_located_global_is_kept() -> None:
    text = "VAR_GLOBAL RETAIN n AT %MW0 : INT; END_VAR PROGRAM p n := n + 1; END_PROGRAM"
    before: Any = program(text)
    scan(before)
    scan(before)
    after: Any = program(text)
    after.restore(before.retained())
    scan(after)
    assert after.n == 3


def test_a_global_list_of_twincat_has_inputs_without_numbers(tmp_path: Path) -> None:
    (tmp_path / "Io.st").write_text("VAR_GLOBAL go AT %I* : BOOL; out AT %Q* : BOOL; END_VAR")
    (tmp_path / "Main.st").write_text("PROGRAM Main out := Io.go; END_PROGRAM")
    made: Any = load_program(str(tmp_path), dialect="twincat")
    assert roles(made) == {"go": (Role.INPUT, ""), "out": (Role.OUTPUT, "")}


def test_an_input_address_may_stay_unbound_and_a_bound_one_reads_its_tag(tmp_path: Path) -> None:
    (tmp_path / "p.st").write_text("PROGRAM p %QX0.0 := %IX0.0; %QX0.1 := %IX0.1; END_PROGRAM")
    source = ProgramConfig("src", "src.st")
    (tmp_path / "src.st").write_text("PROGRAM src VAR_OUTPUT on : BOOL := TRUE; END_VAR END_PROGRAM")
    main = ProgramConfig("p", "p.st", {"IX0_0": InputBinding("src.on")})
    layout = image_for([config.bind((str(tmp_path),)) for config in (source, main)], {})
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    image = layout.attach(memory)
    image.writer(INPUTS).publish([], 0)
    now = [0]
    config = PlcConfig("", layout.describe(), "", (source, main), python_path=(str(tmp_path),))
    runner = TaskRunner(config, image, lambda: now[0])
    runner.start()
    for _ in range(3):
        now[0] = runner.deadline_ns
        runner.run_once()
    assert (runner.outputs.last()["p.QX0_0"], runner.outputs.last()["p.QX0_1"]) == (True, False)


@pytest.mark.parametrize(
    ("one", "other", "codesys", "twincat"),
    [
        # CODESYS counts in units of the size: %QW1 is the bytes 2 and 3, %MD1 the words 2 and 3. TwinCAT counts bytes.
        ("%QX0.0", "%QW0", True, True),
        ("%QX2.0", "%QW1", True, True),
        ("%QX3.7", "%QW1", True, False),
        ("%QX1.0", "%QW1", False, True),
        ("%MW2", "%MD1", True, True),
        ("%MW3", "%MD1", True, True),
        ("%MW4", "%MD1", False, True),
        ("%MB8", "%ML1", True, True),
        ("%QX0.0", "%QX0.1", False, False),
        ("%QW0", "%MW0", False, False),
        ("%QW0", "%QW0", False, False),
        ("%IX0.0", "%IW0", False, False),
    ],
)
def test_addresses_that_overlap_elsewhere_are_a_finding_and_an_error_in_the_vendors_dialects(
    one: str, other: str, codesys: bool, twincat: bool
) -> None:
    types = {"X": "BOOL", "B": "BYTE", "W": "WORD", "D": "DWORD", "L": "LWORD"}
    first, second = types[one[2]], types[other[2]]
    text = f"VAR_GLOBAL a AT {one} : {first}; END_VAR PROGRAM p VAR x : {second}; END_VAR\nx := {other}; END_PROGRAM"
    found = [warning for warning in findings(parse_all(text, "p.st")) if warning.id == "ST109"]
    assert [(w.line, w.column) for w in found] == ([(2, 6)] if codesys else [])
    compile_text(text)
    for dialect, expected in (("codesys", codesys), ("twincat", twincat)):
        if not expected:
            compile_text(text, dialect=dialect_of(dialect))
            continue
        with pytest.raises(FileInvalid, match=f"2:6: {other} and {one} share bits in {dialect}"):
            compile_text(text, dialect=dialect_of(dialect))
