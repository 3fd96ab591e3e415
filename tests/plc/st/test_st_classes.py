"""Classes and function blocks with methods, inheritance and access (IEC 61131-3:2013, tables 48 and 53)."""

from __future__ import annotations

import copy
from typing import Any

import pytest
from st_bench import program, run, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.compiler.compile import CompiledUnit, compile_text
from fieldtwin.plc.st.dialects import DIALECTS
from fieldtwin.plc.st.program import program_class


def compiled(text: str, dialect: str = "codesys") -> CompiledUnit:
    return compile_text(text, "p.st", DIALECTS[dialect])


def in_codesys(text: str) -> Any:
    made = program_class(compiled(text))()
    scan(made)
    return made


COUNTER = """
CLASS Counter
  VAR PUBLIC top : INT := 100; END_VAR
  VAR value : INT; END_VAR
  METHOD PUBLIC Up : INT
    VAR_INPUT by : INT := 1; END_VAR
    VAR_OUTPUT at_top : BOOL; END_VAR
    value := value + by;
    IF value >= top THEN
      value := top;
      at_top := TRUE;
    END_IF
    Up := value;
  END_METHOD
  METHOD PUBLIC Reset VAR_INPUT value : INT; END_VAR
    THIS.value := value;
  END_METHOD
  METHOD PUBLIC Swap VAR_IN_OUT other : INT; END_VAR
    VAR old : INT; END_VAR
    old := value;
    value := other;
    other := old;
  END_METHOD
  METHOD PUBLIC Twice : INT
    VAR_TEMP first : INT; END_VAR
    first := Up();
    Twice := first + THIS.Up();
  END_METHOD
END_CLASS
"""


def test_methods_have_parameters_a_result_and_variables_of_their_own() -> None:
    got = run(
        "c : Counter; a, b, n : INT; full : BOOL; other : INT := 50;",
        """a := c.Up();
           n := c.Up(by := 4, at_top => full);
           c.Reset(20);
           b := c.Twice();
           c.Swap(other);""",
        COUNTER,
    )
    assert (got["a"], got["n"], got["full"], got["b"], got["other"]) == (1, 5, False, 43, 22)
    assert (got["c"].v_value, got["c"].v_top) == (50, 100)


def test_a_public_variable_is_read_and_assigned_from_outside_and_outputs_are_set() -> None:
    got = run("c : Counter; n : INT; full : BOOL;", "c.top := 3; n := c.Up(7, at_top => full) + c.top;", COUNTER)
    assert (got["n"], got["full"]) == (6, True)


def test_variables_of_a_method_begin_anew_at_each_call() -> None:
    text = """
        FUNCTION_BLOCK Box
          METHOD PUBLIC Next : INT
            VAR n : INT := 5; END_VAR
            n := n + 1;
            Next := n;
          END_METHOD
        END_FUNCTION_BLOCK"""
    assert run("b : Box; first, second : INT;", "first := b.Next(); second := b.Next();", text)["second"] == 6


LAMPS = """
FUNCTION_BLOCK Lamp
  VAR_INPUT on : BOOL; END_VAR
  VAR_OUTPUT level, calls : INT; END_VAR
  VAR step : INT := 10; END_VAR
  METHOD PROTECTED Wanted : INT
    IF on THEN Wanted := step; END_IF
  END_METHOD
  METHOD PUBLIC Show : INT
    Show := THIS.Wanted();
  END_METHOD
  calls := calls + 1;
  level := THIS.Wanted();
END_FUNCTION_BLOCK
FUNCTION_BLOCK Dimmer EXTENDS Lamp
  VAR_INPUT factor : INT := 3; END_VAR
  METHOD PROTECTED OVERRIDE Wanted : INT
    Wanted := factor * SUPER.Wanted();
  END_METHOD
  SUPER();
  level := level + 1;
END_FUNCTION_BLOCK
FUNCTION_BLOCK Silent EXTENDS Dimmer
END_FUNCTION_BLOCK
"""


def test_a_derived_block_has_the_variables_of_its_base_and_overrides_its_methods() -> None:
    got = run("d : Dimmer; n : INT;", "d(on := TRUE, factor := 4); n := d.Show();", LAMPS)
    assert (got["d"].v_level, got["d"].v_calls, got["n"]) == (41, 1, 40)


def test_the_body_of_a_base_runs_only_if_super_calls_it() -> None:
    got = run("l : Lamp; s : Silent;", "l(on := TRUE); s(on := TRUE);", LAMPS)
    assert (got["l"].v_level, got["l"].v_calls) == (10, 1)
    assert (got["s"].v_level, got["s"].v_calls) == (0, 0)


def test_an_inherited_method_calls_the_overriding_one_over_two_levels() -> None:
    assert run("s : Silent; n : INT;", "s.on := TRUE; n := s.Show();", LAMPS)["n"] == 30


def test_an_instance_of_a_derived_block_can_be_passed_for_its_base() -> None:
    text = f"""{LAMPS}
        FUNCTION Measure : INT VAR_IN_OUT lamp : Lamp; END_VAR Measure := lamp.Show(); END_FUNCTION"""
    got = run(
        "l : Lamp; d : Dimmer; a, b : INT;", "l.on := TRUE; d.on := TRUE; a := Measure(l); b := Measure(d);", text
    )
    assert (got["a"], got["b"]) == (10, 30)
    with pytest.raises(FileInvalid, match="VAR_IN_OUT lamp of Measure; expected Dimmer; got Lamp"):
        run("l : Lamp; a : INT;", "a := Measure(l);", text.replace("lamp : Lamp;", "lamp : Dimmer;"))


def test_an_abstract_method_is_called_in_the_derived_block() -> None:
    text = """
        FUNCTION_BLOCK ABSTRACT Shape
          METHOD PUBLIC ABSTRACT Area : REAL END_METHOD
          METHOD PUBLIC Paint : REAL Paint := 2.0 * Area(); END_METHOD
        END_FUNCTION_BLOCK
        FUNCTION_BLOCK FINAL Square EXTENDS Shape
          VAR_INPUT side : REAL; END_VAR
          METHOD PUBLIC OVERRIDE Area : REAL Area := side * side; END_METHOD
        END_FUNCTION_BLOCK"""
    assert run("s : Square; r : REAL;", "s.side := 3.0; r := s.Paint();", text)["r"] == 18.0


def test_a_block_may_extend_a_class() -> None:
    text = f"""{COUNTER}
        FUNCTION_BLOCK Display EXTENDS Counter
          VAR_OUTPUT shown : INT; END_VAR
          shown := Up(2) * 10;
        END_FUNCTION_BLOCK"""
    assert run("d : Display; n : INT;", "d(); n := d.shown + d.Up();", text)["n"] == 23


def test_actions_and_temporary_variables_of_a_base_are_inherited() -> None:
    text = """
        FUNCTION_BLOCK Base
          VAR_OUTPUT n : INT; END_VAR
          VAR_TEMP step : INT; END_VAR
          step := 5;
          Add();
          ACTION Add: n := n + step; END_ACTION
        END_FUNCTION_BLOCK
        FUNCTION_BLOCK Derived EXTENDS Base
          SUPER();
          Add();
        END_FUNCTION_BLOCK"""
    got = run("d : Derived;", "d(); d.Add();", text)
    assert got["d"].v_n == 15


def test_an_instance_in_an_array_is_selected_by_its_index() -> None:
    got = run("c : ARRAY[1..3] OF Counter; i : INT := 2; n : INT;", "n := c[i].Up(5) + c[i + 1].Up(2);", COUNTER)
    assert (got["n"], [one.v_value for one in got["c"]]) == (7, [0, 5, 2])


def test_an_instance_in_a_method_and_one_in_a_structure_are_usable() -> None:
    text = f"""{COUNTER}
        TYPE Pair : STRUCT a, b : Counter; END_STRUCT END_TYPE
        FUNCTION_BLOCK User
          VAR pair : Pair; END_VAR
          METHOD PUBLIC Both : INT
            VAR own : Counter; END_VAR
            Both := pair.a.Up(1) + pair.b.Up(2) + own.Up(100);
          END_METHOD
        END_FUNCTION_BLOCK"""
    assert run("u : User; n, m : INT;", "n := u.Both(); m := u.Both();", text)["m"] == 106


def test_calls_with_outputs_inside_an_expression_keep_their_order() -> None:
    got = run("c : Counter; n : INT; full : BOOL;", "c.top := 2; n := c.Up() * 10 + c.Up(at_top => full);", COUNTER)
    assert got["full"] is True
    assert got["c"].v_value == 2


def test_codesys_calls_the_body_of_the_base_in_a_method() -> None:
    before = """FUNCTION_BLOCK a VAR_OUTPUT n : INT; at : TIME; END_VAR VAR t : TON; END_VAR
      n := n + 1; t(IN := TRUE, PT := T#1h, ET => at); END_FUNCTION_BLOCK
    FUNCTION_BLOCK b EXTENDS a
      METHOD PUBLIC twice SUPER^(); SUPER^(); END_METHOD
      n := n + 100; END_FUNCTION_BLOCK
    FUNCTION_BLOCK c EXTENDS b METHOD PUBLIC once SUPER^(); END_METHOD END_FUNCTION_BLOCK"""
    found = run("one : c;", "one.twice(); one.once();", before, scans=3, dialect="codesys")
    assert (found["one"].v_n, found["one"].v_at) == (306, 20_000_000)
    referring = before.replace("VAR_OUTPUT", "VAR_IN_OUT io : INT; END_VAR VAR_OUTPUT", 1)
    with pytest.raises(FileInvalid, match="and a has VAR_IN_OUT, which exist only in its own call"):
        run("one : b;", "", referring, dialect="codesys")


def test_a_body_and_a_method_that_call_each_other_are_refused() -> None:
    before = """FUNCTION_BLOCK a METHOD PUBLIC m END_METHOD THIS^.m(); END_FUNCTION_BLOCK
    FUNCTION_BLOCK b EXTENDS a METHOD PUBLIC m SUPER^(); END_METHOD END_FUNCTION_BLOCK"""
    with pytest.raises(FileInvalid, match="calls itself"):
        run("one : b;", "one();", before, dialect="codesys")


@pytest.mark.parametrize(
    "statement",
    ["c[Next(calls := n)].Reset(5);", "r := c[Next(calls := n)].Up();", "r := c[Next(calls := n)].Up(EN := TRUE);"],
)
def test_the_instance_of_a_call_is_selected_once(statement: str) -> None:
    got = run(
        "c : ARRAY[1..9] OF Counter; n, r : INT;",
        statement,
        f"{COUNTER} FUNCTION Next : INT VAR_IN_OUT calls : INT; END_VAR calls := calls + 1; Next := calls; END_FUNCTION",
    )
    assert got["n"] == 1
    assert [one.v_value for one in got["c"]] == [max(got["r"], 5 * ("Reset" in statement)), *[0] * 8]


def test_arguments_of_a_call_are_evaluated_from_left_to_right() -> None:
    got = run(
        "c : Counter; n : INT; full : BOOL;",
        "n := Joined(c.Up(), c.Up(at_top => full));",
        f"{COUNTER} FUNCTION Joined : INT VAR_INPUT a, b : INT; END_VAR Joined := 10 * a + b; END_FUNCTION",
    )
    assert got["n"] == 12


def test_en_and_eno_control_a_method() -> None:
    got = run("c : Counter; n : INT := 7; done : BOOL := TRUE;", "n := c.Up(EN := FALSE, ENO => done);", COUNTER)
    assert (got["n"], got["done"], got["c"].v_value) == (0, False, 0)


def test_a_method_may_declare_en_and_eno() -> None:
    text = """
        CLASS Half
          METHOD PUBLIC Of : INT
            VAR_INPUT EN : BOOL; x : INT; END_VAR
            VAR_OUTPUT ENO : BOOL; END_VAR
            Of := x / 2;
            IF x MOD 2 <> 0 THEN ENO := FALSE; END_IF
          END_METHOD
        END_CLASS"""
    got = run(
        "h : Half; n, m : INT; even, odd, off : BOOL;",
        "n := h.Of(TRUE, 8, ENO => even) + h.Of(TRUE, 7, ENO => odd); m := h.Of(EN := FALSE, x := 8, ENO => off);",
        text,
    )
    assert (got["n"], got["m"], got["even"], got["odd"], got["off"]) == (7, 0, True, False, False)


def test_a_method_reads_the_edge_of_an_input() -> None:
    text = """
        FUNCTION_BLOCK Button
          VAR_INPUT pressed : BOOL R_EDGE; END_VAR
          METHOD PUBLIC Seen : BOOL Seen := pressed; END_METHOD
          METHOD PUBLIC Raw : BOOL Raw := THIS.pressed; END_METHOD
        END_FUNCTION_BLOCK"""
    got = run(
        "b : Button; seen : ARRAY[1..4] OF BOOL;",
        "b(TRUE); seen[1] := b.Seen(); seen[2] := b.Raw(); b(TRUE); seen[3] := b.Seen(); seen[4] := b.Raw();",
        text,
    )
    assert got["seen"] == [True, True, False, False]


# -- in a running program -----------------------------------------------------------------------------------------------


def test_variables_of_an_instance_are_inspected_under_the_names_of_the_source() -> None:
    made = program(f"{LAMPS} PROGRAM Main VAR d : Dimmer; END_VAR d(on := TRUE); END_PROGRAM")
    scan(made)
    assert list(made.internal_names()) == ["d.on", "d.level", "d.calls", "d.step", "d.factor"]
    found = made.internal("D.Step")
    assert found is not None
    assert found.value == 10


def test_retained_instances_keep_inherited_variables() -> None:
    text = f"{LAMPS} PROGRAM Main VAR RETAIN d : Dimmer; END_VAR d(on := TRUE); END_PROGRAM"
    made, restarted = program(text), program(text)
    scan(made)
    scan(made, 2)
    restarted.restore(made.retained())
    scan(restarted)
    assert restarted.st_body.v_d.v_calls == 3


def test_the_state_of_a_program_contains_its_instances_and_a_copy_is_separate() -> None:
    made: Any = program(f"{COUNTER} PROGRAM Main VAR c : Counter; n : INT; END_VAR n := c.Up(); END_PROGRAM")
    scan(made)
    twin = copy.deepcopy(made)
    assert twin.whole_state(0) == made.whole_state(0)
    scan(twin, 2)
    assert (made.n, twin.n) == (1, 2)
    assert twin.whole_state(0) != made.whole_state(0)


def test_an_error_in_a_method_names_its_line() -> None:
    text = """CLASS C
METHOD PUBLIC Divide : INT VAR_INPUT by : INT; END_VAR
  Divide := 10 / by;
END_METHOD
END_CLASS
PROGRAM Main VAR c : C; n : INT; END_VAR n := c.Divide(0); END_PROGRAM"""
    made = program(text)
    with pytest.raises(Exception, match="division by zero") as caught:
        scan(made)
    lines = [entry.lineno + 1 for entry in caught.traceback if str(entry.path).endswith("test.st")]
    assert lines == [6, 3]


# -- errors ---------------------------------------------------------------------------------------------------------------

BASE = """FUNCTION_BLOCK Base
VAR hidden : INT; END_VAR
VAR PRIVATE secret : INT; END_VAR
METHOD PUBLIC Run : INT VAR_INPUT a : INT; END_VAR END_METHOD
METHOD Guarded END_METHOD
METHOD PRIVATE Own END_METHOD
METHOD PUBLIC FINAL Fixed END_METHOD
END_FUNCTION_BLOCK
"""


def derived(part: str, before: str = BASE) -> str:
    return f"{before}FUNCTION_BLOCK Derived EXTENDS Base\n{part}\nEND_FUNCTION_BLOCK"


def used(statement: str, variables: str = "b : Base;") -> str:
    return f"{BASE}PROGRAM Main VAR {variables} n : INT; END_VAR\n{statement}\nEND_PROGRAM"


@pytest.mark.parametrize(
    ("text", "place", "message"),
    [
        (used("b.Guarded();"), "10:2", r"Base\.Guarded is PROTECTED .*METHOD PUBLIC can be called everywhere"),
        (used("b.Own();"), "10:2", r"Base\.Own is PRIVATE \(only Base itself can use it\)"),
        (used("n := b.hidden;"), "10:7", r"hidden is a local variable of Base \(declare it in VAR_OUTPUT"),
        (used("b.Walk();"), "10:2", "in Base, a member 'Walk' is not declared"),
        (used("n := b.Run('x');"), "10:12", r"a of Run; expected INT; got STRING"),
        (used("b.Run(1, 2);"), "10:10", r"arguments of Run; expected 1 \(a\); got 2"),
        (used("THIS.Run(1);"), "10:1", "THIS outside a FUNCTION_BLOCK or CLASS"),
        (derived("Own();"), "10:1", r"Base\.Own is PRIVATE"),
        (derived("SUPER.Own();"), "10:6", r"Base\.Own is PRIVATE"),
        (derived("secret := 1;"), "10:1", "secret is PRIVATE in the POU that declares it"),
        (derived("SUPER(1);"), "10:7", "SUPER takes no arguments"),
        (derived("VAR hidden : INT; END_VAR"), "10:5", "hidden is declared twice"),
        (derived("METHOD PUBLIC Run : INT VAR_INPUT a : INT; END_VAR END_METHOD"), "10:15", "METHOD OVERRIDE"),
        (
            derived("METHOD PUBLIC OVERRIDE Run : INT VAR_INPUT a : DINT; END_VAR END_METHOD"),
            "10:24",
            r"Derived\.Run overrides Base\.Run with a different signature; "
            r"expected Run\(a : INT\) : INT; got Run\(a : DINT\) : INT",
        ),
        (
            derived("METHOD PUBLIC OVERRIDE Run : INT VAR_INPUT b : INT; END_VAR END_METHOD"),
            "10:24",
            "a different signature",
        ),
        (derived("METHOD PRIVATE OVERRIDE Guarded END_METHOD"), "10:25", "a different access; expected PROTECTED"),
        (derived("METHOD PUBLIC OVERRIDE Fixed END_METHOD"), "10:24", r"overrides Base\.Fixed, which is FINAL"),
        (derived("METHOD PRIVATE OVERRIDE Own END_METHOD"), "10:25", r"overrides Base\.Own, which is PRIVATE"),
        (derived("METHOD PUBLIC OVERRIDE Walk END_METHOD"), "10:24", "declared OVERRIDE, but no base has it"),
        (derived("METHOD PUBLIC PRIVATE Walk END_METHOD"), "10:23", "Walk is PUBLIC and PRIVATE"),
        (derived("METHOD Walk END_METHOD METHOD Walk END_METHOD"), "10:31", "Walk is declared twice in Derived"),
        (derived("METHOD hidden END_METHOD"), "10:8", "hidden is declared twice in Derived"),
        (derived("METHOD Walk : INT VAR Walk : INT; END_VAR END_METHOD"), "10:8", "name of the method's result"),
        (derived("METHOD ABSTRACT Walk END_METHOD"), "10:17", "expected FUNCTION_BLOCK ABSTRACT Derived"),
        (derived("METHOD Walk n := 1; END_METHOD"), "10:13", "a variable 'n' is not declared"),
        (derived("THIS^.hidden := 1;"), "10:1", r"expected THIS \(the dialects codesys and twincat write the mark"),
        (derived("PROPERTY Level : INT GET END_GET END_PROPERTY"), "10:10", "the standard has methods only"),
        (derived("METHOD Walk SUPER(); END_METHOD"), "10:13", "SUPER in the body of a FUNCTION_BLOCK"),
        (
            derived("METHOD Walk given := 1; END_METHOD VAR_IN_OUT given : INT; END_VAR").replace(
                "METHOD Walk given := 1; END_METHOD VAR_IN_OUT given : INT; END_VAR",
                "VAR_IN_OUT given : INT; END_VAR METHOD Walk given := 1; END_METHOD",
            ),
            "10:45",
            "given is a VAR_IN_OUT of Derived and does not exist while a method is executed",
        ),
        ("FUNCTION_BLOCK a EXTENDS a END_FUNCTION_BLOCK", "1:26", "a extends itself: a -> a"),
        (
            "CLASS a EXTENDS b END_CLASS CLASS b EXTENDS c END_CLASS CLASS c EXTENDS a END_CLASS",
            "1:73",
            "c extends itself: a -> b -> c -> a",
        ),
        ("CLASS a EXTENDS b, c END_CLASS CLASS b END_CLASS CLASS c END_CLASS", "1:20", "a extends two POUs"),
        ("CLASS a EXTENDS b END_CLASS", "1:17", "EXTENDS b: 'b' is not declared; expected a CLASS"),
        ("CLASS a EXTENDS TON END_CLASS", "1:17", "a standard function block cannot be extended"),
        ("CLASS a EXTENDS b END_CLASS FUNCTION_BLOCK b END_FUNCTION_BLOCK", "1:17", "which is a FUNCTION_BLOCK"),
        ("CLASS a EXTENDS b END_CLASS CLASS FINAL b END_CLASS", "1:17", "a extends b, which is FINAL"),
        (
            "CLASS ABSTRACT a END_CLASS PROGRAM p VAR x : a; END_VAR END_PROGRAM",
            "1:46",
            "a is ABSTRACT and has no instances",
        ),
        (
            "CLASS ABSTRACT a END_CLASS PROGRAM p VAR x : ARRAY[1..2] OF a; END_VAR END_PROGRAM",
            "1:46",
            "a is ABSTRACT and has no instances",
        ),
        (
            "CLASS ABSTRACT a METHOD ABSTRACT m END_METHOD END_CLASS CLASS b EXTENDS a END_CLASS",
            "1:63",
            r"b does not implement a\.m, which is ABSTRACT",
        ),
        (
            "CLASS ABSTRACT a METHOD ABSTRACT m END_METHOD END_CLASS "
            "CLASS b EXTENDS a METHOD OVERRIDE m SUPER.m(); END_METHOD END_CLASS",
            "1:98",
            r"a\.m is ABSTRACT and has no statements",
        ),
        ("CLASS ABSTRACT a METHOD ABSTRACT m m(); END_METHOD END_CLASS", "1:36", r"a\.m has statements; expected none"),
        ("CLASS a END_CLASS PROGRAM p VAR x : a; END_VAR x(); END_PROGRAM", "1:48", "x is an instance of the class a"),
        ("METHOD m END_METHOD", "1:8", "m is a method or property that belongs to no FUNCTION_BLOCK"),
        ("PROGRAM p METHOD m END_METHOD END_PROGRAM", "1:18", "method m in a PROGRAM"),
        ("CLASS a METHOD m SUPER.m(); END_METHOD END_CLASS", "1:18", "SUPER in a, which extends nothing"),
        ("CLASS a METHOD m m(); END_METHOD END_CLASS", "1:18", r"a\.m calls itself"),
        (
            "CLASS a METHOD m k(); END_METHOD METHOD k END_METHOD END_CLASS "
            "CLASS b EXTENDS a METHOD OVERRIDE k m(); END_METHOD END_CLASS",
            "1:",
            "calls itself: ",
        ),
        (
            "CLASS a METHOD PUBLIC m VAR x : BOOL R_EDGE; END_VAR END_METHOD END_CLASS",
            "1:29",
            "a METHOD, which keeps no values",
        ),
        (
            "FUNCTION_BLOCK a VAR_INPUT x : BOOL R_EDGE; END_VAR END_FUNCTION_BLOCK "
            "FUNCTION_BLOCK b EXTENDS a END_FUNCTION_BLOCK",
            "1:28",
            "no edge in a POU that b extends",
        ),
    ],
)
def test_an_error_has_its_place(text: str, place: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message) as caught:
        compiled(text, "standard")
    assert f"{caught.value.line}:{caught.value.column}".startswith(place)


def test_each_error_of_several_methods_is_reported_once() -> None:
    with pytest.raises(FileInvalid) as caught:
        compiled(
            "CLASS a METHOD m x := 1; END_METHOD METHOD n y := 2; END_METHOD END_CLASS CLASS b EXTENDS a END_CLASS"
        )
    assert [error.message for error in (caught.value, *caught.value.others)] == [
        "a variable 'x' is not declared",
        "a variable 'y' is not declared",
    ]


WRONG_BASES = """FUNCTION_BLOCK Valve EXTENDS Vlave
VAR n : INT; inner : Pump; END_VAR
METHOD PUBLIC OVERRIDE Open
  position := 1;
  n := TRUE;
END_METHOD
  SUPER();
  Step();
  THIS.Open();
  inner(go := TRUE);
  n := 'text';
END_FUNCTION_BLOCK
FUNCTION_BLOCK Vlve
END_FUNCTION_BLOCK
FUNCTION_BLOCK Special EXTENDS Valve
VAR k : INT; END_VAR
  k := position;
  k := FALSE;
END_FUNCTION_BLOCK
CLASS Wrong EXTENDS Pump
END_CLASS
FUNCTION_BLOCK Pump
VAR_INPUT go : BOOL; END_VAR
VAR m : INT; END_VAR
  m := TRUE;
END_FUNCTION_BLOCK
TYPE Both : STRUCT valve : Valve; x : INT; END_STRUCT; END_TYPE
PROGRAM Main
VAR valve : Valve; special : Special; both : Both; valves : ARRAY[1..2] OF Valve; ok : INT; no : Unknown; END_VAR
  valve(wide := TRUE);
  valve.Close();
  ok := valve.position + special.position + both.valve.position;
  valves[1](wide := TRUE);
  ok := missing;
END_PROGRAM
"""


def test_a_wrong_base_hides_no_other_errors_and_causes_none() -> None:
    """Defect: an error in EXTENDS was the only one that was reported of a file."""
    with pytest.raises(FileInvalid) as caught:
        compile_text(WRONG_BASES, "p.st")
    found = [(e.line, e.message) for e in (caught.value, *caught.value.others)]
    assert sorted(found) == [
        (1, "EXTENDS Vlave: 'Vlave' is not declared"),
        (5, "assigned to n"),
        (11, "assigned to n"),
        (18, "assigned to k"),
        (20, "EXTENDS Pump, which is a FUNCTION_BLOCK"),
        (25, "assigned to m"),
        (29, "a type 'Unknown' is not declared"),
        (34, "a variable 'missing' is not declared"),
    ]


def test_a_wrong_base_of_a_structure_hides_no_other_errors_and_causes_none() -> None:
    text = """TYPE A EXTENDS Bse : STRUCT x : INT; END_STRUCT
    B EXTENDS A : STRUCT y : Unknown; END_STRUCT
    C : STRUCT a : A; END_STRUCT END_TYPE
    PROGRAM p VAR a : A; b : B; c : C; n : INT; ref : POINTER TO A; END_VAR
    n := a.inherited + b.inherited + c.a.inherited; ref := ADR(a); n := ref^.inherited;
    n := TRUE; END_PROGRAM"""
    with pytest.raises(FileInvalid) as caught:
        compile_text(text, "p.st", DIALECTS["codesys"])
    found = [(e.line, e.message) for e in (caught.value, *caught.value.others)]
    assert sorted(found) == [
        (1, "EXTENDS Bse: 'Bse' is not declared"),
        (2, "a type 'Unknown' is not declared"),
        (6, "assigned to n"),
    ]
