"""Configurations: tasks, programs with connections, and VAR_CONFIG (IEC 61131-3:2013, 6.8 and table 62)."""

from __future__ import annotations

from typing import Any

import pytest
from st_bench import program

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.program import ScanInfo
from fieldtwin.plc.st.findings.find import findings
from fieldtwin.plc.st.program import StProgram, instance_of
from fieldtwin.plc.st.syntax.parse import parse_all

MAIN = """PROGRAM Main
VAR_INPUT x : INT; on : BOOL; END_VAR
VAR_OUTPUT out : INT; END_VAR
VAR light AT %Q* : BOOL; n : INT; END_VAR
  n := n + 1; out := x + n; light := on;
END_PROGRAM
"""
TWO = (
    MAIN
    + """CONFIGURATION Config0
  VAR_GLOBAL y : INT := 40; z : INT; END_VAR
  RESOURCE Res0 ON PLC
    VAR_GLOBAL button AT %IX0.0 : BOOL; total AT %MW5 : INT; END_VAR
    TASK fast(INTERVAL := T#20ms, PRIORITY := 1);
    TASK slow(INTERVAL := T#1s500ms);
    PROGRAM a WITH fast : Main(x := y, on := button, out => z);
    PROGRAM RETAIN b WITH slow : Main(x := 3, on := NOT %IX0.1, out => total);
    PROGRAM c : Main;
  END_RESOURCE
  VAR_ACCESS seen : Res0.a.n : INT READ_ONLY; all : Res0.a.out : INT READ_WRITE; END_VAR
END_CONFIGURATION
"""
)


def made(text: str, *names: str) -> list[Any]:
    together: dict[Any, Any] = {}
    return [type(program(text, name))(together) for name in names]  # type: ignore[call-arg]


def scan(one: StProgram, number: int = 1) -> None:
    one.execute(ScanInfo(number, number, number == 1))


def test_the_programs_of_a_configuration_have_their_tasks() -> None:
    unit = made(TWO, "a")[0].st_unit
    tasks = {one.name: one.task and (one.task.name, one.task.interval_ns, one.task.priority) for one in unit.instances}
    assert tasks == {"a": ("fast", 20_000_000, 1), "b": ("slow", 1_500_000_000, 0), "c": None}


def test_a_program_is_connected_with_global_variables() -> None:
    a, b = made(TWO, "a", "b")
    scan(a)
    assert (a.out, a.light, a.st_resource.globals.v_z) == (41, False, 41)
    a.button = True
    scan(a, 2)
    assert (a.out, a.light, a.st_resource.globals.v_z) == (42, True, 42)
    scan(b)
    assert (b.out, b.total, b.light) == (4, 4, True)
    b.IX0_1 = True
    scan(b, 2)
    assert (b.total, b.light) == (5, False)


def test_a_connected_input_needs_no_tag_and_a_bound_tag_has_precedence() -> None:
    (a,) = made(TWO, "a")
    assert {v.name for v in a.variables.values() if v.needs_tag} == {"n"}
    a.x = 100
    scan(a)
    assert a.out == 101


def test_a_program_without_connections_is_not_connected() -> None:
    (c,) = made(TWO, "c")
    assert c.variables["x"].needs_tag
    c.x, c.on = 7, True
    scan(c)
    assert (c.out, c.st_resource.globals.v_z) == (8, 0)


def test_the_program_of_a_configuration_has_to_be_named_if_there_are_several() -> None:
    with pytest.raises(FileInvalid, match=r"which program of the configuration is meant.*expected a, b"):
        program(TWO, "Main")


def test_the_only_program_of_a_configuration_is_found_by_its_type() -> None:
    text = (
        MAIN
        + "CONFIGURATION c VAR_GLOBAL y : INT := 2; END_VAR PROGRAM only : Main(x := y, on := TRUE); END_CONFIGURATION"
    )
    for name in ("", "main", "ONLY"):
        (one,) = made(text, name)
        found = instance_of(one.st_unit, name)
        assert found is not None
        assert found.name == "only"
        scan(one)
        assert one.out == 3


def test_var_config_gives_an_address_and_an_initial_value() -> None:
    config = "VAR_CONFIG Res0.a.light AT %QX3.1 : BOOL := TRUE; Res0.a.n : INT := 10; END_VAR END_CONFIGURATION"
    text = TWO.replace("END_CONFIGURATION", config)
    (a,) = made(text, "a")
    assert (a.variables["light"].address, a.light, a.n) == ("%QX3.1", True, 10)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("Main(x := y,", "Main(q := y,", "13:32: Main has no input 'q'; expected x, on"),
        ("out => z", "n => z", "13:54: Main has no output 'n'; expected out"),
        ("Main(x := y,", "Main(y,", "an argument of a program without the name of a variable"),
        ("Main(x := y,", "Main(x := button,", "x of a; expected INT; got BOOL"),
        ("Main(x := y,", "Main(f WITH fast, x := y,", "a task for a function block is not supported"),
        ("out => z", "out => button", "button cannot be assigned to"),
        ("x := y,", "x := n,", "a variable 'n' is not declared"),
        ("INTERVAL := T#20ms", "INTERVAL := 20", "INTERVAL; expected TIME"),
        ("INTERVAL := T#20ms", "EVERY := T#20ms", "not a property of a task"),
        ("TASK slow", "TASK fast(INTERVAL := T#1s);\n    TASK slow", "task fast is declared twice"),
        ("PROGRAM RETAIN b", "PROGRAM a", "program a is declared twice"),
        (
            "END_CONFIGURATION",
            "VAR_CONFIG d.n : INT := 1; END_VAR END_CONFIGURATION",
            "no program of the configuration",
        ),
        ("END_CONFIGURATION", "VAR_CONFIG a.q : INT := 1; END_VAR END_CONFIGURATION", "Main has no such variable"),
        (
            "END_CONFIGURATION",
            "VAR_CONFIG a.n AT %MW0 : INT; END_VAR END_CONFIGURATION",
            "n cannot get the address %MW0; expected n AT %M[*] in Main",
        ),
        (
            "END_CONFIGURATION",
            "VAR_CONFIG a.n : INT := 1; a.n : INT := 2; END_VAR END_CONFIGURATION",
            "VAR_CONFIG a.n: it has a value already",
        ),
    ],
)
def test_mistakes_in_configurations_are_refused(old: str, new: str, said: str) -> None:
    with pytest.raises(FileInvalid, match=said):
        program(TWO.replace(old, new, 1), "a")


COMPOUND = """TYPE Point : STRUCT x, y : INT; END_STRUCT; END_TYPE
PROGRAM Main
VAR_INPUT name : STRING := 'none'; levels : ARRAY[1..3] OF INT; at : Point; END_VAR
VAR_OUTPUT text : STRING; sums : ARRAY[1..2] OF INT; END_VAR
VAR_IN_OUT total : INT; box : Point; END_VAR
VAR length, first : INT; END_VAR
  length := LEN(name); first := levels[1] + at.x; text := CONCAT(name, '!'); sums[2] := first;
  total := total + 1; box.y := box.y + total;
END_PROGRAM
"""


def test_a_program_has_strings_arrays_structures_and_in_outs() -> None:
    one: Any = program(COMPOUND)
    assert set(one.variables) == {"total", "length", "first"}
    scan(one)
    scan(one, 2)
    assert (one.length, one.first, one.total) == (4, 0, 2)
    assert one.internal("text").value == "'none!'"
    assert one.internal("box.y").value == 3


def test_a_configuration_connects_strings_arrays_structures_and_in_outs() -> None:
    text = (
        COMPOUND
        + """CONFIGURATION c
VAR_GLOBAL n : STRING := 'pump'; l : ARRAY[1..3] OF INT := [5, 6, 7]; p : Point := (x := 2); out : STRING; s : ARRAY[1..2] OF INT;
  count : INT := 10; b : Point; END_VAR
PROGRAM a : Main(name := n, levels := l, at := p, total := count, box := b, text => out, sums => s);
END_CONFIGURATION"""
    )
    (one,) = made(text, "a")
    scan(one)
    shared = one.st_resource.globals
    assert (one.length, one.first, one.total) == (4, 7, 11)
    assert (shared.v_out, shared.v_s, shared.v_count, shared.v_b.m_y) == ("pump!", [0, 7], 11, 11)
    shared.v_count, shared.v_l[0] = 20, 50
    scan(one, 2)
    assert (one.total, shared.v_count, shared.v_b.m_y, shared.v_s) == (21, 21, 32, [0, 52])


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("total := 5", "total of a; expected a variable for a VAR_IN_OUT"),
        ("total := fixed", "fixed cannot be assigned to"),
        ("total => count", "Main has no output 'total'"),
    ],
)
def test_an_in_out_needs_a_variable(argument: str, said: str) -> None:
    text = (
        COMPOUND
        + f"""CONFIGURATION c
VAR_GLOBAL count : INT; END_VAR VAR_GLOBAL CONSTANT fixed : INT := 1; END_VAR PROGRAM a : Main({argument}); END_CONFIGURATION"""
    )
    with pytest.raises(FileInvalid, match=said):
        program(text)


def test_inputs_and_outputs_that_are_no_tags_are_a_finding() -> None:
    found = [one.message.split()[0] for one in findings(parse_all(COMPOUND, "p.st")) if one.id == "ST110"]
    assert found == ["name", "levels", "text", "sums"]
