"""Interfaces (IEC 61131-3:2013, 6.6.6 and table 51), and properties as CODESYS and TwinCAT have them."""

from __future__ import annotations

import copy
from typing import Any

import pytest
from st_bench import program, run, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.dialects import DIALECTS
from fieldtwin.plc.st.program import program_class
from fieldtwin.plc.st.values import LogicError


def vendor(text: str) -> Any:
    """Return a program in the dialect codesys after its first scan."""
    made = program_class(compile_text(text, "test.st", DIALECTS["codesys"]))()
    scan(made)
    return made


DRIVES = """
INTERFACE Speed
  METHOD Set : BOOL VAR_INPUT rpm : INT; END_VAR END_METHOD
END_INTERFACE
INTERFACE Drive EXTENDS Speed
  METHOD Get : INT END_METHOD
END_INTERFACE
FUNCTION_BLOCK Motor IMPLEMENTS Drive
  VAR rpm : INT; END_VAR
  METHOD PUBLIC Set : BOOL VAR_INPUT rpm : INT; END_VAR
    THIS.rpm := rpm;
    Set := TRUE;
  END_METHOD
  METHOD PUBLIC Get : INT Get := rpm; END_METHOD
  METHOD PUBLIC Self : Drive Self := THIS; END_METHOD
END_FUNCTION_BLOCK
CLASS Geared IMPLEMENTS Drive
  VAR motor : Motor; END_VAR
  METHOD PUBLIC Set : BOOL VAR_INPUT rpm : INT; END_VAR Set := motor.Set(10 * rpm); END_METHOD
  METHOD PUBLIC Get : INT Get := motor.Get() / 10; END_METHOD
END_CLASS
"""


def test_a_call_through_an_interface_reaches_the_assigned_instance() -> None:
    got = run(
        "m : Motor; g : Geared; d : Drive; a, b, c : INT; done : BOOL;",
        """d := m; done := d.Set(rpm := 7); a := d.Get();
           d := g; done := d.Set(5); b := d.Get();
           c := m.Get();""",
        DRIVES,
    )
    assert (got["a"], got["b"], got["c"], got["done"]) == (7, 5, 7, True)


def test_references_are_compared_and_assigned_and_null_is_no_instance() -> None:
    got = run(
        "m, other : Motor; d, e : Drive; s : Speed; first, second, third, fourth, fifth : BOOL;",
        """first := d = NULL;
           d := m; e := d; s := e;
           second := d = e AND s = d AND d <> NULL;
           e := other;
           third := d <> e;
           d := NULL;
           fourth := d = NULL AND NOT (e = NULL);
           fifth := e = other;""",
        DRIVES,
    )
    assert [got[name] for name in ("first", "second", "third", "fourth", "fifth")] == [True] * 5


def test_a_call_through_null_is_a_fault_that_names_the_variable_and_the_line() -> None:
    made = program(f"{DRIVES}PROGRAM Main\nVAR d : Drive; n : INT; END_VAR\n\nn := d.Get();\nEND_PROGRAM")
    with pytest.raises(LogicError, match="d is NULL; expected an instance") as caught:
        scan(made)
    line = (DRIVES.count("\n") + 1) + 3
    assert [entry.lineno + 1 for entry in caught.traceback if str(entry.path).endswith("test.st")] == [line]


def test_interfaces_are_parameters_results_elements_of_arrays_and_members() -> None:
    got = run(
        "m : ARRAY[1..2] OF Motor; all : ARRAY[1..2] OF Drive; i, n : INT; p : Pair; done : BOOL; d : Drive;",
        """FOR i := 1 TO 2 DO all[i] := m[i]; done := all[i].Set(i * 10); END_FOR
           p.a := all[2];
           d := m[1].Self();
           n := Doubled(all[1]) + p.a.Get() + d.Get() + Doubled(m[2]);""",
        f"""{DRIVES}
        TYPE Pair : STRUCT a : Drive; END_STRUCT END_TYPE
        FUNCTION Doubled : INT VAR_INPUT d : Drive; END_VAR Doubled := 2 * d.Get(); END_FUNCTION""",
    )
    assert got["n"] == 20 + 20 + 10 + 40


def test_an_interface_in_var_in_out_is_assigned_for_the_caller() -> None:
    got = run(
        "m : Motor; d : Drive; n : INT; done : BOOL;",
        "done := m.Set(3); Choose(m := m, d := d); n := d.Get();",
        f"{DRIVES} FUNCTION Choose VAR_IN_OUT m : Motor; d : Drive; END_VAR d := m; END_FUNCTION",
    )
    assert got["n"] == 3


def test_a_derived_block_implements_the_interfaces_of_its_base() -> None:
    text = f"""{DRIVES}
        FUNCTION_BLOCK Fast EXTENDS Motor
          METHOD PUBLIC OVERRIDE Get : INT Get := 2 * SUPER.Get(); END_METHOD
        END_FUNCTION_BLOCK"""
    got = run(
        "f : Fast; s : Speed; d : Drive; n : INT; done : BOOL;", "s := f; d := f; done := s.Set(4); n := d.Get();", text
    )
    assert got["n"] == 8


def test_an_abstract_block_leaves_methods_of_its_interface_to_derived_ones() -> None:
    text = f"""{DRIVES}
        FUNCTION_BLOCK ABSTRACT Half IMPLEMENTS Drive
          METHOD PUBLIC Set : BOOL VAR_INPUT rpm : INT; END_VAR Set := Get() > rpm; END_METHOD
        END_FUNCTION_BLOCK
        FUNCTION_BLOCK Whole EXTENDS Half
          METHOD PUBLIC OVERRIDE Get : INT Get := 5; END_METHOD
        END_FUNCTION_BLOCK"""
    got = run("w : Whole; high, low : BOOL;", "high := w.Set(4); low := w.Set(6);", text)
    assert (got["high"], got["low"]) == (True, False)
    with pytest.raises(FileInvalid, match=r"Whole does not implement Half\.Get, which is ABSTRACT"):
        program(text.replace("METHOD PUBLIC OVERRIDE Get : INT Get := 5; END_METHOD", ""))


# -- in a running program -----------------------------------------------------------------------------------------------

CHOICE = f"""{DRIVES}
PROGRAM Main
VAR_INPUT second : BOOL; END_VAR
VAR_OUTPUT now : INT; END_VAR
VAR a, b : Motor; d : Drive; done : BOOL; END_VAR
  IF second THEN d := b; ELSE d := a; END_IF
  done := d.Set(now + 1);
  now := d.Get();
END_PROGRAM"""


def test_a_copy_of_a_program_refers_to_its_own_instances() -> None:
    made: Any = program(CHOICE)
    scan(made)
    twin = copy.deepcopy(made)
    assert twin.whole_state(0) == made.whole_state(0)
    assert twin.st_body.v_d.of is twin.st_body.v_a
    scan(twin, 2)
    assert (made.st_body.v_a.v_rpm, twin.st_body.v_a.v_rpm) == (1, 2)


def test_the_state_of_a_program_shows_to_which_instance_a_variable_refers() -> None:
    states = []
    for to in ("a", "b"):
        made: Any = program(f"{DRIVES} PROGRAM Main VAR a, b : Motor; d : Drive; END_VAR d := {to}; END_PROGRAM")
        scan(made)
        states.append(made.whole_state(0))
    assert states[0] != states[1]


def test_a_variable_of_an_interface_type_shows_the_type_of_its_instance() -> None:
    made: Any = program(CHOICE)
    found = made.internal("d")
    assert (found.type, found.value) == ("Drive", "NULL")
    scan(made)
    assert made.internal("D").value == "an instance of Motor"


def test_references_cannot_be_retained() -> None:
    with pytest.raises(FileInvalid, match="d is RETAIN and refers to an instance"):
        program(f"{DRIVES} PROGRAM Main VAR RETAIN d : Drive; END_VAR END_PROGRAM")
    holder = f"{DRIVES} FUNCTION_BLOCK Holder VAR d : ARRAY[1..2] OF Drive; END_VAR END_FUNCTION_BLOCK"
    with pytest.raises(FileInvalid, match="h is RETAIN and refers to an instance"):
        program(f"{holder} PROGRAM Main VAR RETAIN h : Holder; END_VAR END_PROGRAM")


def test_an_instance_with_an_interface_is_retained_without_its_number() -> None:
    made: Any = program(
        f"{DRIVES} PROGRAM Main VAR RETAIN m : Motor; END_VAR VAR b : BOOL; END_VAR b := m.Set(9); END_PROGRAM"
    )
    scan(made)
    assert made.retained() == {"m": {"v_rpm": 9}}


def test_a_method_that_calls_itself_through_an_interface_is_a_fault() -> None:
    text = """
        INTERFACE Step METHOD Go END_METHOD END_INTERFACE
        FUNCTION_BLOCK Loop IMPLEMENTS Step
          VAR next : Step; END_VAR
          METHOD PUBLIC Go next := THIS; next.Go(); END_METHOD
        END_FUNCTION_BLOCK
        PROGRAM Main VAR l : Loop; END_VAR l.Go(); END_PROGRAM"""
    with pytest.raises(LogicError, match="calls nested too deep"):
        scan(program(text))


def test_instances_that_wrap_others_of_the_same_interface_are_no_recursion() -> None:
    text = """
        INTERFACE Value METHOD Read : INT END_METHOD END_INTERFACE
        FUNCTION_BLOCK Source IMPLEMENTS Value METHOD PUBLIC Read : INT Read := 3; END_METHOD END_FUNCTION_BLOCK
        FUNCTION_BLOCK Plus IMPLEMENTS Value
          VAR_INPUT of : Value; END_VAR
          METHOD PUBLIC Read : INT Read := of.Read() + 1; END_METHOD
        END_FUNCTION_BLOCK"""
    assert run("s : Source; a, b : Plus; n : INT;", "a(of := s); b(of := a); n := b.Read();", text)["n"] == 5


# -- errors ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "place", "message"),
    [
        (
            "INTERFACE i METHOD m END_METHOD END_INTERFACE CLASS c IMPLEMENTS i END_CLASS",
            "1:66",
            r"c does not implement i\.m",
        ),
        (
            "INTERFACE i METHOD m : INT END_METHOD END_INTERFACE "
            "CLASS c IMPLEMENTS i METHOD PUBLIC m : BOOL END_METHOD END_CLASS",
            "1:88",
            r"c\.m implements i\.m with a different signature; expected m\(\) : INT; got m\(\) : BOOL",
        ),
        (
            "INTERFACE i METHOD m END_METHOD END_INTERFACE CLASS c IMPLEMENTS i METHOD m END_METHOD END_CLASS",
            "1:75",
            r"c\.m implements i\.m; expected METHOD PUBLIC; got PROTECTED",
        ),
        ("INTERFACE i METHOD m m(); END_METHOD END_INTERFACE", "1:22", r"i\.m has statements"),
        (
            "INTERFACE i EXTENDS j END_INTERFACE INTERFACE j EXTENDS i END_INTERFACE",
            "1:57",
            "j extends itself: i -> j -> i",
        ),
        (
            "INTERFACE i METHOD m END_METHOD END_INTERFACE INTERFACE j METHOD m : INT END_METHOD END_INTERFACE "
            "INTERFACE k EXTENDS i, j END_INTERFACE",
            "1:109",
            r"k extends i\.m and j\.m, which have different signatures",
        ),
        (
            "CLASS c IMPLEMENTS d END_CLASS CLASS d END_CLASS",
            "1:20",
            "IMPLEMENTS d, which is a CLASS; expected an INTERFACE",
        ),
        (
            "CLASS c EXTENDS i END_CLASS INTERFACE i END_INTERFACE",
            "1:17",
            "EXTENDS i, which is a INTERFACE; expected a CLASS",
        ),
        (f"{DRIVES} PROGRAM p VAR d : Drive; END_VAR d := 3; END_PROGRAM", "", "assigned to d; expected Drive; got 3"),
        (f"{DRIVES} PROGRAM p VAR d : Drive; END_VAR d := 0; END_PROGRAM", "", "assigned to d; expected Drive; got 0"),
        (
            f"{DRIVES} PROGRAM p VAR d : Drive; t : TON; END_VAR d := t; END_PROGRAM",
            "",
            "assigned to d; expected Drive; got TON",
        ),
        (f"{DRIVES} PROGRAM p VAR d : Drive; s : Speed; END_VAR d := s; END_PROGRAM", "", "expected Drive; got Speed"),
        (f"{DRIVES} PROGRAM p VAR m : Motor; d : Drive; END_VAR m := d; END_PROGRAM", "", "expected Motor; got Drive"),
        (
            f"{DRIVES} PROGRAM p VAR s : Speed; n : INT; END_VAR n := s.Get(); END_PROGRAM",
            "",
            "in Speed, a method 'Get'",
        ),
        (f"{DRIVES} PROGRAM p VAR d : Drive; END_VAR d(); END_PROGRAM", "", "d cannot be called"),
        (
            f"{DRIVES} PROGRAM p VAR n : INT; END_VAR n := NULL; END_PROGRAM",
            "",
            "assigned to n; expected INT; got NULL",
        ),
        (f"{DRIVES} PROGRAM p VAR_INPUT d : Drive; END_VAR END_PROGRAM", "", "d cannot be bound to a tag"),
    ],
)
def test_an_error_has_its_place(text: str, place: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message) as caught:
        compile_text(text)
    assert f"{caught.value.line}:{caught.value.column}".startswith(place)


# -- properties -----------------------------------------------------------------------------------------------------------

TANK = """
INTERFACE I_Level
  PROPERTY Level : REAL GET END_GET SET END_SET END_PROPERTY
END_INTERFACE
FUNCTION_BLOCK Tank IMPLEMENTS I_Level
VAR _level : REAL := 1.5; writes : INT; END_VAR
  _level := _level + 1.0;
END_FUNCTION_BLOCK
METHOD Fill : REAL
VAR_INPUT by : REAL; END_VAR
  Level := Level + by;
  THIS^.Level := THIS^.Level + by;
  Fill := Level;
END_METHOD
PROPERTY PUBLIC Level : REAL
GET
  Level := _level;
END_GET
SET
VAR limited : REAL; END_VAR
  limited := LIMIT(0.0, Level, 10.0);
  _level := limited;
  writes := writes + 1;
END_SET
END_PROPERTY
PROPERTY Count : INT
GET
  Count := writes;
END_GET
END_PROPERTY
"""


def test_a_property_calls_its_accessors_outside_and_inside_its_block() -> None:
    made = vendor(f"""{TANK} PROGRAM Main VAR t : Tank; i : I_Level; a, b, c, d : REAL; n : INT; END_VAR
        a := t.Level;
        t.Level := 50;
        b := t.Level - 1.0;
        c := t.Fill(-2.0);
        i := t;
        i.Level := i.Level / 2;
        d := t.Level;
        n := t.Count;
        END_PROGRAM""")
    assert (made.a, made.b, made.c, made.d, made.n) == (1.5, 9.0, 6.0, 3.0, 4)


def test_a_method_after_the_end_of_its_block_may_be_called_by_the_block() -> None:
    made = vendor("""
        FUNCTION_BLOCK Box
        VAR_OUTPUT n : INT; END_VAR
          n := Next(n);
        END_FUNCTION_BLOCK
        METHOD PRIVATE Next : INT
        VAR_INPUT n : INT; END_VAR
          Next := n + 1;
        END_METHOD
        PROGRAM Main VAR b : Box; n : INT; END_VAR b(); n := b.n; END_PROGRAM
        """)
    assert made.n == 1


def test_a_property_may_be_a_structure_an_interface_or_the_target_of_an_output() -> None:
    made = vendor("""
        TYPE Point : STRUCT x, y : INT; END_STRUCT END_TYPE
        INTERFACE I_Other METHOD Read : INT END_METHOD END_INTERFACE
        FUNCTION_BLOCK Other IMPLEMENTS I_Other METHOD Read : INT Read := 8; END_METHOD END_FUNCTION_BLOCK
        FUNCTION_BLOCK Box
        VAR _amount : INT; END_VAR
          METHOD Ask VAR_OUTPUT n : INT; END_VAR n := 6; END_METHOD
          PROPERTY Amount : INT GET Amount := THIS^._amount; END_GET SET THIS^._amount := Amount; END_SET END_PROPERTY
        END_FUNCTION_BLOCK
        FUNCTION_BLOCK Full EXTENDS Box
        VAR point : Point; other : Other; END_VAR
          PROPERTY Place : Point GET Place := point; END_GET SET point := Place; END_SET END_PROPERTY
          PROPERTY Inner : I_Other GET Inner := other; END_GET END_PROPERTY
        END_FUNCTION_BLOCK
        PROGRAM Main VAR b : Full; p : Point; n, x, r : INT; END_VAR
          b.Ask(n => b.Amount);
          n := b.Amount;
          p.x := 5;
          b.Place := p;
          p.x := 100;
          x := b.Place.x;
          r := b.Inner.Read();
        END_PROGRAM""")
    assert (made.n, made.x, made.r) == (6, 5, 8)


def test_codesys_compares_an_interface_with_0() -> None:
    made = vendor(f"""{TANK} PROGRAM Main VAR t : Tank; i : I_Level; a, b : BOOL; END_VAR
        a := i = 0; i := t; b := i <> 0; i := 0; END_PROGRAM""")
    assert (made.a, made.b, made.st_body.v_i) == (True, True, None)


def test_variables_in_var_inst_keep_their_values_in_each_instance() -> None:
    text = """
        FUNCTION_BLOCK Base
          METHOD Next : INT
            VAR_INST n : INT := 10; after : TON; END_VAR
            after(IN := TRUE, PT := T#15ms);
            n := n + 1;
            Next := n;
            IF after.Q THEN Next := -n; END_IF
          END_METHOD
        END_FUNCTION_BLOCK
        FUNCTION_BLOCK Derived EXTENDS Base METHOD Other : INT VAR_INST n : INT; END_VAR n := n + 1; Other := n; END_METHOD
        END_FUNCTION_BLOCK
        PROGRAM Main VAR a : Base; b : Derived; x, y, z : INT; END_VAR
          x := a.Next(); y := b.Next(); z := b.Other(); y := b.Next();
        END_PROGRAM"""
    made = vendor(text)
    assert (made.x, made.y, made.z) == (11, 12, 1)
    for number in (2, 3):
        scan(made, number)
    assert (made.x, made.y, made.z) == (-13, -16, 3)
    for names, message in (
        ("VAR_INST next : INT; END_VAR", "next is the name of the method's result, and is declared again"),
        ("VAR n : INT; END_VAR VAR_INST N : INT; END_VAR", "N is declared twice"),
        ("VAR_INST n, N : INT; END_VAR", "N is declared twice"),
    ):
        with pytest.raises(FileInvalid, match=f"test.st:1:.*{message}"):
            program(
                f"FUNCTION_BLOCK F METHOD Next : INT {names} Next := 1; END_METHOD END_FUNCTION_BLOCK\nPROGRAM p END_PROGRAM",
                "p", "codesys",
            )  # fmt: skip
    for refused, dialect in ((text, "standard"), ("PROGRAM p VAR_INST n : INT; END_VAR END_PROGRAM", "codesys")):
        with pytest.raises(FileInvalid, match="VAR_INST; expected VAR"):
            compile_text(refused, "", DIALECTS[dialect])


def test_displays_see_variables_in_var_inst_below_their_method_and_no_tags() -> None:
    made = vendor("""
        FUNCTION_BLOCK Base
          METHOD Next_One : INT VAR_INST last_n : INT := 10; after : TON; END_VAR
            last_n := last_n + 1; Next_One := last_n; END_METHOD
          PROPERTY Level : INT GET VAR_INST n : INT := 5; END_VAR Level := n; END_GET END_PROPERTY
        END_FUNCTION_BLOCK
        PROGRAM Main VAR a : ARRAY[1..2] OF Base; x, y : INT; END_VAR
          x := a[2].Next_One(); y := Twice();
        METHOD Twice : INT VAR_INST n : INT; END_VAR n := n + 2; Twice := n; END_METHOD
        END_PROGRAM""")
    assert (made.x, made.y) == (11, 2)
    assert list(made.variables) == ["x", "y"]
    own = ["Level.Get.n", "Next_One.after.ET", "Next_One.after.IN", "Next_One.after.PT", "Next_One.after.Q"]
    every = sorted(f"a[{n}].{name}" for n in (1, 2) for name in [*own, "Next_One.last_n"])
    assert sorted(made.internal_names()) == [*sorted(["Twice.n", *every])]
    values = {"A[2].next_one.LAST_N": 11, "a[1].Next_One.last_n": 10, "a[1].Level.Get.n": 5, "twice.N": 2}
    for path, value in values.items():
        found, reader = made.internal(path), made.variable_reader(path)
        assert (found.value, reader.read(), found.type) == (value, value, "INT")
    for unknown in ("a[1].Next_One", "a[1].Next_One.m", "a[1].last_n", "a[1].Level.n", "Twice"):
        assert (made.internal(unknown), made.variable_reader(unknown)) == (None, None)


def test_a_program_has_methods_in_codesys() -> None:
    made = vendor("""PROGRAM Main VAR n : INT; END_VAR
        n := Twice(4);
        METHOD Twice : INT VAR_INPUT a : INT; END_VAR Twice := 2 * a; END_METHOD
        END_PROGRAM""")
    assert made.n == 8


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("t.Count := 1;", r"property Tank\.Count has no SET"),
        ("t.Level := 'x';", "assigned to t; expected REAL; got STRING"),
        ("t.Levels := 1.0;", "in Tank, a member 'Levels' is not declared"),
        ("i.Count := 1;", "in I_Level, a member 'Count' is not declared"),
        ("t.Level.3 := TRUE;", "t cannot be assigned to|a bit of a value without bits"),
        ("n := t.Level();", "Level"),
    ],
)
def test_an_error_in_the_use_of_a_property_names_it(statement: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        vendor(f"{TANK} PROGRAM Main VAR t : Tank; i : I_Level; n : INT; END_VAR {statement} END_PROGRAM")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("FUNCTION_BLOCK b PROPERTY P : INT END_PROPERTY END_FUNCTION_BLOCK", "property P has neither GET nor SET"),
        (
            "INTERFACE i PROPERTY P : INT GET END_GET SET END_SET END_PROPERTY END_INTERFACE "
            "FUNCTION_BLOCK b IMPLEMENTS i PROPERTY P : INT GET END_GET END_PROPERTY END_FUNCTION_BLOCK",
            r"b does not implement SET of i\.P",
        ),
        (
            "FUNCTION_BLOCK b METHOD P END_METHOD PROPERTY P : INT GET END_GET END_PROPERTY END_FUNCTION_BLOCK",
            "declared twice",
        ),
        ("FUNCTION_BLOCK b METHOD FB_Init : BOOL END_METHOD END_FUNCTION_BLOCK", "the first two inputs of FB_init"),
        ("FUNCTION_BLOCK b PROPERTY P : INT SET END_SET END_PROPERTY p := P + 1; END_FUNCTION_BLOCK", "no GET"),
    ],
)
def test_an_error_in_the_declaration_of_a_property_names_it(text: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        compile_text(text, "", DIALECTS["codesys"])
