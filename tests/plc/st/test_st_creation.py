"""FB_init of the dialects of CODESYS: instances with arguments, and initial values that use variables and functions."""

from __future__ import annotations

import copy

import pytest
from st_bench import program, run, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.dialects import DIALECTS

FIXED = "bInitRetains : BOOL; bInCopyCode : BOOL;"
PUMP = f"""FUNCTION_BLOCK Pump
VAR_INPUT level : INT := 5; END_VAR
VAR number : INT := 1; name : STRING; highest : INT; END_VAR
METHOD FB_init : BOOL
VAR_INPUT {FIXED} start : INT; text : STRING := 'none'; END_VAR
number := number + start; name := text;
END_METHOD
METHOD Count : INT
Count := number;
END_METHOD
PROPERTY Top : INT
SET highest := Top; END_SET
GET Top := highest; END_GET
END_PROPERTY
END_FUNCTION_BLOCK
"""


def test_fb_init_gets_the_arguments_of_the_declaration_after_the_initial_values() -> None:
    found = run("a : Pump(4); b : Pump(start := 6, text := 'east',);", "", PUMP, dialect="codesys")
    assert (found["a"].v_number, found["a"].v_name) == (5, "none")
    assert (found["b"].v_number, found["b"].v_name) == (7, "east")


def test_the_initial_values_of_a_declaration_are_assigned_after_fb_init_also_to_properties() -> None:
    found = run("a : Pump(4) := (level := 8, Top := 90);", "", PUMP, dialect="twincat")
    assert (found["a"].v_number, found["a"].v_level, found["a"].v_highest) == (5, 8, 90)


def test_each_element_of_an_array_gets_its_arguments() -> None:
    declared = """a : ARRAY[1..2] OF Pump[(1), (start := 2, text := 'b')] := [(level := 7), (level := 9)];
    b : ARRAY[0..1, 0..1] OF Pump[(1), (2), (3), (4)]; c : ARRAY[1..3] OF Pump(5);"""
    found = run(declared, "", PUMP, dialect="codesys")
    assert [(one.v_number, one.v_level, one.v_name) for one in found["a"]] == [(2, 7, "none"), (3, 9, "b")]
    assert [[one.v_number for one in row] for row in found["b"]] == [[2, 3], [4, 5]]
    assert [one.v_number for one in found["c"]] == [6, 6, 6]
    assert len({id(one) for one in found["c"]}) == 3


def test_fb_init_of_the_base_is_called_first_with_the_inputs_of_the_same_name() -> None:
    more = f"""FUNCTION_BLOCK Double EXTENDS Pump
    METHOD FB_init : BOOL
    VAR_INPUT {FIXED} factor : INT; start : INT; END_VAR
    number := number * factor;
    END_METHOD
    END_FUNCTION_BLOCK
    FUNCTION_BLOCK Same EXTENDS Double END_FUNCTION_BLOCK"""
    found = run("a : Double(3, 4); b : Same(start := 1, factor := 10);", "", PUMP + more, dialect="codesys")
    assert (found["a"].v_number, found["b"].v_number) == (15, 20)


def test_fb_init_without_further_inputs_is_called_for_every_instance_also_in_structures_and_functions() -> None:
    before = f"""FUNCTION_BLOCK Counter VAR n : INT; END_VAR VAR_OUTPUT q : INT; END_VAR
    METHOD FB_init : BOOL VAR_INPUT {FIXED} END_VAR n := n + 41; END_METHOD
    n := n + 1; q := n;
    END_FUNCTION_BLOCK
    TYPE Both : STRUCT one : Counter; other : ARRAY[1..2] OF Counter; END_STRUCT END_TYPE
    FUNCTION First : INT VAR c : Counter; END_VAR c(); First := c.q; END_FUNCTION"""
    found = run("s : Both; x, y : INT;", "x := First(); s.other[2](q => y);", before, dialect="codesys")
    assert (found["s"].m_one.v_n, found["x"], found["y"]) == (41, 42, 42)


def test_arguments_and_initial_values_use_variables_that_are_declared_later() -> None:
    before = PUMP + "FUNCTION Twice : INT VAR_INPUT n : INT; END_VAR Twice := 2 * n; END_FUNCTION"
    found = run("a : Pump(x); x : INT := Twice(y) + 1; y : INT := Twice(10);", "", before, dialect="codesys")
    assert (found["y"], found["x"], found["a"].v_number) == (20, 41, 42)


def test_an_argument_may_be_a_reference_a_pointer_or_an_interface() -> None:
    before = f"""INTERFACE INamed METHOD Id : INT END_METHOD END_INTERFACE
    FUNCTION_BLOCK Owner IMPLEMENTS INamed
    VAR part : Part(THIS^, ADR(count), count); count : INT := 3; END_VAR
    METHOD Id : INT Id := 77; END_METHOD
    part();
    END_FUNCTION_BLOCK
    FUNCTION_BLOCK Part
    VAR owner : INamed; at : POINTER TO INT; same : REFERENCE TO INT; END_VAR VAR_OUTPUT id : INT; END_VAR
    METHOD FB_init : BOOL
    VAR_INPUT {FIXED} from : INamed; p : POINTER TO INT; r : REFERENCE TO INT; END_VAR
    owner := from; at := p; same REF= r;
    END_METHOD
    id := owner.Id(); at^ := at^ + 1; same := same * 10;
    END_FUNCTION_BLOCK"""
    found = run("o : Owner;", "o();", before, dialect="codesys")
    assert (found["o"].v_part.v_id, found["o"].v_count) == (77, 40)


def test_global_instances_and_global_initial_values_use_each_other_in_any_order() -> None:
    text = f"""{PUMP}
    VAR_GLOBAL first : Pump(second); second : INT := third * 2; third : INT := 4; END_VAR
    PROGRAM p VAR_OUTPUT n : INT; END_VAR n := first.Count() + second; END_PROGRAM"""
    made = program(text, "p", "codesys")
    scan(made)
    assert made.st_body.v_n == 17


def test_copies_and_programs_of_one_unit_have_their_own_instances() -> None:
    made = program(f"{PUMP} PROGRAM p VAR a : Pump(1); END_VAR END_PROGRAM", "p", "codesys")
    other = copy.deepcopy(made)
    other.st_body.v_a.v_number = 9
    assert made.st_body.v_a.v_number == 2


@pytest.mark.parametrize(
    ("declared", "message"),
    [
        ("a : Pump;", "an instance of Pump without the arguments of FB_init; expected start"),
        ("a : Pump();", "arguments of FB_init of Pump; expected start, text"),
        ("a : Pump(1, 'x', 3);", "FB_init of Pump"),
        ("a : Pump(begin := 1);", "begin"),
        ("a : Pump('x');", "start of FB_init of Pump; expected INT"),
        ("a : Pump(start := 1, start := 2);", "given twice"),
        ("a : Pump(start => x);", "FB_init of Pump has no outputs"),
        ("a : ARRAY[1..3] OF Pump[(1), (2)];", "expected 3 lists; got 2"),
        ("a : TON(5);", "TON has no method FB_init"),
        ("a : INT(5);", "INT has no method FB_init"),
        ("a : ARRAY[1..2] OF Pump;", "without the arguments"),
        ("a : Pump(1) := (bottom := 2);", "'bottom' is not declared"),
        ("a : INT := b; b : INT := a;", "initial values of . and . need each other"),
        ("a : INT := nowhere;", "'nowhere' is not declared"),
    ],
)
def test_wrong_instances_and_initial_values_are_refused(declared: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        run(f"x : INT; {declared}", "", PUMP, dialect="codesys")


@pytest.mark.parametrize(
    ("block", "message"),
    [
        ("FUNCTION_BLOCK b METHOD FB_init : BOOL END_METHOD END_FUNCTION_BLOCK", "the first two inputs of FB_init"),
        (
            f"FUNCTION_BLOCK b METHOD FB_init : BOOL VAR_INPUT {FIXED} END_VAR VAR_IN_OUT x : INT; END_VAR END_METHOD "
            "END_FUNCTION_BLOCK",
            "VAR_IN_OUT in FB_init",
        ),
        (
            f"{PUMP} FUNCTION_BLOCK b EXTENDS Pump METHOD FB_init : BOOL VAR_INPUT {FIXED} END_VAR END_METHOD END_FUNCTION_BLOCK",
            "FB_init of b has no input start, which FB_init of Pump has",
        ),
    ],
)
def test_wrong_declarations_of_fb_init_are_refused(block: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        program(f"{block} PROGRAM p END_PROGRAM", "p", "codesys")


def test_the_standard_has_no_arguments_of_instances_and_constant_initial_values_only() -> None:
    block = "FUNCTION_BLOCK b VAR_INPUT n : INT; END_VAR END_FUNCTION_BLOCK"
    with pytest.raises(FileInvalid, match=r"b has no method FB_init.*codesys and twincat"):
        run("a : b(1);", "", block)
    with pytest.raises(FileInvalid, match="'x' is not declared"):
        run("x : INT := 1; y : INT := x;", "")


def test_an_error_during_the_creation_names_the_line() -> None:
    block = PUMP.replace("name := text;", "\nnumber := number / (start - 4);")
    with pytest.raises(FileInvalid, match=r"FB_init: .*zero") as error:
        run("a : Pump(4);", "", block, dialect="codesys")
    assert error.value.line == 7


def test_methods_that_only_calls_execute_give_a_warning() -> None:
    block = "FUNCTION_BLOCK b\nMETHOD FB_exit : BOOL END_METHOD\nMETHOD fb_reinit : BOOL END_METHOD END_FUNCTION_BLOCK"
    unit = compile_text(f"{block} PROGRAM p VAR x : b; END_VAR END_PROGRAM", "", DIALECTS["twincat"])
    found = [(each.id, each.line, each.message) for each in unit.warnings]
    message = "only calls in the program execute {} of b"
    assert found == [("ST009", 2, message.format("FB_exit")), ("ST009", 3, message.format("fb_reinit"))]
