"""Variables of function blocks and structures at addresses (IEC 61131-3:2013, 6.5.5, 6.5.6 and table 16).

Each instance has its own variable at ``%I*``, ``%Q*`` or ``%M*``. A program offers it by its path, and VAR_CONFIG gives it an
address. A full address in VAR of a function block is one variable for all instances.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
from st_bench import program, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.image.image import INPUTS
from fieldtwin.plc.binding import InputBinding, image_for, load_program
from fieldtwin.plc.program import Role
from fieldtwin.plc.runtime.config import PlcConfig, ProgramConfig
from fieldtwin.plc.runtime.runner import TaskRunner
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.compiler.configurations.parts import MAX_PARTS
from fieldtwin.plc.st.dialects import dialect_of
from fieldtwin.plc.st.findings.find import findings
from fieldtwin.plc.st.online.carry import Carrying
from fieldtwin.plc.st.syntax.parse import parse_all

PUMP = """FUNCTION_BLOCK Pump
VAR_INPUT on : BOOL; END_VAR
VAR_OUTPUT fault AT %I* : BOOL; END_VAR
VAR run AT %Q* : BOOL; starts AT %M* : INT; END_VAR
IF on AND NOT fault AND NOT run THEN starts := starts + 1; END_IF
run := on AND NOT fault;
END_FUNCTION_BLOCK
"""
TWO = (
    PUMP
    + "PROGRAM Main VAR a : Pump; more : ARRAY[2..3] OF Pump; END_VAR a(on := TRUE); more[3](on := TRUE); END_PROGRAM\n"
)


def roles(made: Any) -> dict[str, tuple[Role, str]]:
    return {v.name: (v.role, v.address) for v in made.variables.values()}


def test_each_instance_has_its_own_variables() -> None:
    made: Any = program(TWO)
    assert roles(made) == {
        f"{of}.{name}": (role, "")
        for of in ("a", "more[2]", "more[3]")
        for name, role in (("fault", Role.INPUT), ("run", Role.OUTPUT))
    }
    assert not any(v.needs_tag for v in made.variables.values())
    scan(made)
    shown = made.__dict__
    assert (shown["a.run"], shown["more[2].run"], shown["more[3].run"]) == (True, False, True)
    shown["more[3].fault"] = True
    scan(made)
    assert (shown["a.run"], shown["more[3].run"]) == (True, False)


def test_an_unbound_input_keeps_the_value_that_the_program_gives_it() -> None:
    text = (
        PUMP.replace("run := on", "fault := starts = 1; run := on")
        + "PROGRAM p VAR a : Pump; END_VAR a(on := TRUE); END_PROGRAM"
    )
    with pytest.raises(FileInvalid, match="fault cannot be assigned to"):
        program(text)
    made: Any = program(text, dialect="twincat")
    scan(made)
    assert (made.__dict__["a.run"], made.st_body.v_a.v_fault) == (False, True)


def test_the_line_that_assigned_an_output_of_an_instance_is_known() -> None:
    made: Any = program(TWO)
    assert str(made.last_assignment("a.run")[0]) == "test.st:4", (
        "an output with its initial value: the line of its declaration"
    )
    scan(made)
    assert str(made.last_assignment("a.run")[0]) == "test.st:6"
    made.put("a.run", False)
    assert (made.last_assignment("a.run")[0], made.st_body.v_a.v_run) == (None, False)


def test_a_derived_block_has_the_located_variables_of_its_base() -> None:
    text = PUMP + "FUNCTION_BLOCK Big EXTENDS Pump VAR hot AT %I* : BOOL; END_VAR SUPER(); END_FUNCTION_BLOCK\n"
    made: Any = program(text + "PROGRAM p VAR b : Big; END_VAR b(on := TRUE); END_PROGRAM")
    assert set(roles(made)) == {"b.fault", "b.run", "b.hot"}
    scan(made)
    assert made.__dict__["b.run"] is True
    assert str(made.last_assignment("b.run")[0]) == "test.st:6"


def test_blocks_inside_blocks_and_structures_have_longer_paths() -> None:
    text = (
        PUMP
        + "FUNCTION_BLOCK Pair VAR PUBLIC left, right : Pump; END_VAR left(on := TRUE); right(); END_FUNCTION_BLOCK\n"
    )
    text += "TYPE Plant : STRUCT pair : Pair; valve AT %Q* : BOOL; n : INT; END_STRUCT; END_TYPE\n"
    made: Any = program(
        text + "PROGRAM p VAR all : Plant; END_VAR all.pair(); all.valve := all.pair.left.fault; END_PROGRAM"
    )
    assert set(roles(made)) == {
        "all.pair.left.fault", "all.pair.left.run", "all.pair.right.fault", "all.pair.right.run", "all.valve",
    }  # fmt: skip
    made.__dict__["all.pair.left.fault"] = True
    scan(made)
    assert (made.__dict__["all.valve"], made.__dict__["all.pair.left.run"]) == (True, False)


def test_a_structure_or_an_array_at_an_address_is_bound_by_its_members() -> None:
    text = "TYPE Io : STRUCT level : INT; flags : ARRAY[1..2] OF BOOL; END_STRUCT; END_TYPE\n"
    text += "PROGRAM p VAR io AT %I* : Io; copy AT %Q* : Io; raw AT %IB8 : ARRAY[0..1] OF BYTE; END_VAR copy := io; END_PROGRAM"
    made: Any = program(text)
    members = (".level", ".flags[1]", ".flags[2]")
    inputs = {f"io{m}" for m in members} | {"raw[0]", "raw[1]"}
    assert roles(made) == dict.fromkeys(inputs, (Role.INPUT, "")) | {f"copy{m}": (Role.OUTPUT, "") for m in members}
    made.__dict__.update({"io.level": 7, "io.flags[2]": True})
    scan(made)
    assert [made.__dict__[f"copy{m}"] for m in members] == [7, False, True]


def test_a_program_offers_the_instances_in_global_variables_that_it_uses() -> None:
    text = PUMP + "VAR_GLOBAL used : Pump; other : Pump; END_VAR\n"
    text += (
        "FUNCTION_BLOCK F VAR_EXTERNAL used : Pump; END_VAR METHOD Go used(on := TRUE); END_METHOD END_FUNCTION_BLOCK\n"
    )
    made: Any = program(text + "PROGRAM p VAR f : F; END_VAR f.Go(); END_PROGRAM", dialect="codesys")
    assert set(roles(made)) == {"used.fault", "used.run"}
    scan(made)
    assert made.__dict__["used.run"] is True


def test_a_global_list_is_named_where_two_instances_have_one_name(tmp_path: Path) -> None:
    (tmp_path / "Pump.st").write_text(PUMP)
    for name in ("A", "B"):
        (tmp_path / f"{name}.st").write_text("VAR_GLOBAL pump : Pump; END_VAR")
    (tmp_path / "Main.st").write_text("PROGRAM Main A.pump(on := TRUE); B.pump(on := FALSE); END_PROGRAM")
    made: Any = load_program(str(tmp_path), dialect="twincat")
    assert set(roles(made)) == {"pump.fault", "pump.run", "b.pump.fault", "b.pump.run"}
    scan(made)
    assert (made.__dict__["pump.run"], made.__dict__["b.pump.run"]) == (True, False)


def test_a_full_address_in_a_function_block_is_one_variable_for_all_instances() -> None:
    text = "FUNCTION_BLOCK F VAR lamp AT %QX1.0 : BOOL; go AT %IX0.0 : BOOL; END_VAR\n"
    text += "IF go THEN lamp := TRUE; END_IF END_FUNCTION_BLOCK\n"
    made: Any = program(text + "PROGRAM p VAR x, y : F; seen : BOOL; END_VAR x(); y(); seen := %QX1.0; END_PROGRAM")
    assert roles(made) == {
        "QX1_0": (Role.OUTPUT, "%QX1.0"),
        "IX0_0": (Role.INPUT, "%IX0.0"),
        "seen": (Role.LOCAL, ""),
    }
    made.IX0_0 = True
    scan(made)
    assert (made.QX1_0, made.seen) == (True, True)


def test_a_program_may_have_addresses_in_its_inputs_and_outputs() -> None:
    made: Any = program(
        "PROGRAM p VAR_INPUT go AT %I* : BOOL; END_VAR VAR_OUTPUT on AT %QX0.0 : BOOL; END_VAR on := go; END_PROGRAM"
    )
    assert roles(made) == {"go": (Role.INPUT, ""), "on": (Role.OUTPUT, "%QX0.0")}


CONFIGURED = (
    TWO
    + """CONFIGURATION Plant
  RESOURCE Res ON PLC
    TASK t(INTERVAL := T#10ms);
    PROGRAM main WITH t : Main;
  END_RESOURCE
  VAR_CONFIG
    Res.main.a.fault AT %IX0.1 : BOOL;
    main.a.run AT %QX0.1 : BOOL := TRUE;
    Res.main.a.starts AT %MW7 : INT := 40;
    Res.main.more[3].run AT %QX0.2 : BOOL;
  END_VAR
END_CONFIGURATION
"""
)


def test_var_config_gives_variables_of_instances_addresses_and_initial_values() -> None:
    made: Any = program(CONFIGURED, "main")
    assert roles(made) == {
        "a.fault": (Role.INPUT, "%IX0.1"),
        "a.run": (Role.OUTPUT, "%QX0.1"),
        "a.starts": (Role.LOCAL, "%MW7"),
        "more[2].fault": (Role.INPUT, ""),
        "more[2].run": (Role.OUTPUT, ""),
        "more[3].fault": (Role.INPUT, ""),
        "more[3].run": (Role.OUTPUT, "%QX0.2"),
    }
    assert (made.__dict__["a.run"], made.__dict__["a.starts"]) == (True, 40)


def test_var_config_of_twincat_begins_with_the_program_or_the_global_list(tmp_path: Path) -> None:
    (tmp_path / "Pump.st").write_text(PUMP)
    (tmp_path / "Io.st").write_text(
        "VAR_GLOBAL pump : Pump; END_VAR VAR_CONFIG MAIN.a.fault AT %IX0.0 : BOOL; Io.pump.run AT %QX0.0 : BOOL; END_VAR"
    )
    (tmp_path / "MAIN.st").write_text(
        "PROGRAM MAIN VAR a : Pump; END_VAR a(on := TRUE); Io.pump(on := a.fault); END_PROGRAM"
    )
    made: Any = load_program(str(tmp_path), dialect="twincat")
    assert roles(made) == {
        "a.fault": (Role.INPUT, "%IX0.0"),
        "a.run": (Role.OUTPUT, ""),
        "pump.fault": (Role.INPUT, ""),
        "pump.run": (Role.OUTPUT, "%QX0.0"),
    }


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "FUNCTION_BLOCK F VAR_OUTPUT\nq AT %QX0.0 : BOOL; END_VAR END_FUNCTION_BLOCK",
            r"2:1: q AT %QX0.0: an address in VAR_OUTPUT of a FUNCTION_BLOCK; expected %Q\*, because each instance has its own q",
        ),
        (
            "FUNCTION F : INT VAR\nq AT %Q* : BOOL; END_VAR F := 1; END_FUNCTION",
            r"2:1: q AT %Q\*: an address in VAR of a FUNCTION; expected",
        ),
        (
            "FUNCTION_BLOCK F VAR_TEMP\nq AT %M* : BOOL; END_VAR END_FUNCTION_BLOCK",
            r"2:1: q AT %M\*: an address in VAR_TEMP of a FUNCTION_BLOCK",
        ),
        (
            "FUNCTION_BLOCK F METHOD M VAR\nq AT %M* : BOOL; END_VAR END_METHOD END_FUNCTION_BLOCK",
            r"2:1: q AT %M\*: an address in VAR of a METHOD",
        ),
        (
            "TYPE S : STRUCT\nx AT %IX0.0 : BOOL; END_STRUCT; END_TYPE",
            r"2:1: x AT %IX0.0: an address in the structure S; expected %I\*",
        ),
        ("FUNCTION_BLOCK F VAR a AT %QW0 : INT;\nb AT %QW0 : INT; END_VAR END_FUNCTION_BLOCK", "2:1: b and a have one address"),
        ("PROGRAM q VAR\nx AT %I* : ARRAY[0..1] OF TON; END_VAR END_PROGRAM", "2:1: x cannot be bound to a tag"),
        (
            f"{PUMP}PROGRAM\nq VAR x : ARRAY[0..{MAX_PARTS // 2}] OF Pump; END_VAR END_PROGRAM",
            f"9:1: x has too many variables at .*; expected at most {MAX_PARTS}",
        ),
    ],
)  # fmt: skip
def test_wrong_places_of_addresses_are_refused(text: str, said: str) -> None:
    with pytest.raises(FileInvalid, match=said):
        compile_text(f"{text}\nPROGRAM p END_PROGRAM")


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("a.fault AT %IX0.1", "a.flaw AT %IX0.1", "VAR_CONFIG Res.main.a.flaw: no variable at .* has this path"),
        ("a.fault AT %IX0.1", "b.fault AT %IX0.1", "VAR_CONFIG Res.main.b.fault: Main has no such variable"),
        ("a.fault AT %IX0.1", "a.fault AT %QX0.7", r"VAR_CONFIG Res.main.a.fault: the address %QX0.7; expected an address in %I"),
        ("a.fault AT %IX0.1", "a.fault AT %I*", r"VAR_CONFIG Res.main.a.fault: the address %I\*; expected"),
        ("a.starts AT %MW7 : INT", "a.starts AT %MW7 : UINT", "VAR_CONFIG .*main.a.starts: another type; expected INT; got UINT"),
        (
            "more[3].run AT %QX0.2",
            "more[3].run AT %QX0.1", "VAR_CONFIG Res.main.more.3..run: %QX0.1 is the address of another variable",
        ),
        ("a(on := TRUE);", "a(on := %QX0.1);", "VAR_CONFIG main.a.run: %QX0.1 is the address of another variable"),
        ("more[3].run", "more[4].run", "VAR_CONFIG Res.main.more.4..run: no variable at"),
        ("more[3].run", "more[i].run", "not a path such as Resource.Instance.Variable"),
        ("Res.main.a.fault", "Main.a.fault", "VAR_CONFIG Main.b.fault: no program of the configuration"),
    ],
)  # fmt: skip
def test_mistakes_in_var_config_are_refused(before: str, after: str, said: str) -> None:
    text = CONFIGURED.replace(before, after)
    if after == "Main.a.fault":
        text, said = (
            text.replace("PROGRAM main WITH t : Main", "PROGRAM one WITH t : Main"),
            "no program of the configuration",
        )
    with pytest.raises(FileInvalid, match=said):
        program(text)


def test_a_located_string_is_a_finding_and_stays_in_the_program() -> None:
    text = "FUNCTION_BLOCK F VAR\nname AT %I* : STRING; END_VAR END_FUNCTION_BLOCK "
    text += "PROGRAM p VAR f : F; t AT %I* : STRING; END_VAR END_PROGRAM"
    found = [(w.id, w.line, w.message) for w in findings(parse_all(text, "p.st")) if w.id == "ST115"]
    assert found == [
        ("ST115", 2, "name AT %I* is a STRING, which cannot be bound to a tag"),
        ("ST115", 2, "t AT %I* is a STRING, which cannot be bound to a tag"),
    ]
    made: Any = program(text, dialect="twincat")
    assert roles(made) == {}
    assert list(made.internal_names()) == ["f.name", "t"]
    with pytest.raises(FileInvalid, match="t cannot be bound to a tag"):
        program(text)


def test_a_located_output_parameter_at_an_input_address_is_written_by_the_process() -> None:
    assert not [w for w in findings(parse_all(PUMP, "p.st")) if w.id == "ST104"]


def test_watch_shows_the_other_members_of_an_instance_once() -> None:
    made: Any = program(TWO)
    names = list(made.internal_names())
    assert names[:3] == ["a.on", "a.fault", "a.starts"]
    assert made.internal("more[3].starts").value == 0


def test_located_variables_of_instances_are_moved_once_by_an_online_change() -> None:
    old, new = (compile_text(text) for text in (TWO, TWO.replace("starts + 1", "starts + 2")))
    move, differences = Carrying(old, new).program(old.programs[0], new.programs[0])
    before, after = (program(text) for text in (TWO, TWO))
    scan(before)
    move(before.st_body, after.st_body)
    assert (after.st_body.v_a.v_run, after.st_body.v_a.v_starts) == (True, 1)
    assert not differences.changed


def test_the_state_of_a_program_has_its_parts_and_no_lines() -> None:
    made: Any = program(TWO)
    before = made.whole_state(0)
    scan(made)
    after = made.whole_state(0)
    scan(made)
    assert before != after == made.whole_state(0)
    assert "test.st" not in repr(after)
    assert copy.deepcopy(made.st_body).v_a.v_run is True


def test_the_process_image_holds_the_variables_of_instances(tmp_path: Path) -> None:
    (tmp_path / "p.st").write_text(TWO)
    (tmp_path / "src.st").write_text("PROGRAM src VAR_OUTPUT bad : BOOL := TRUE; END_VAR END_PROGRAM")
    configs = (
        ProgramConfig("src", "src.st"),
        ProgramConfig("main", "p.st", {"more[3].fault": InputBinding("src.bad")}),
        ProgramConfig("other", "p.st", {"a.fault": InputBinding("main.a.run")}),
    )
    layout = image_for([config.bind((str(tmp_path),)) for config in configs], {})
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    image = layout.attach(memory)
    image.writer(INPUTS).publish([], 0)
    now = [0]
    runner = TaskRunner(
        PlcConfig("", layout.describe(), "", configs, python_path=(str(tmp_path),)), image, lambda: now[0]
    )
    runner.start()
    for _ in range(3):
        now[0] = runner.deadline_ns
        runner.run_once()
    last = runner.outputs.last()
    assert (last["main.a.run"], last["main.more[3].run"], last["other.a.run"]) == (True, False, False)


@pytest.mark.parametrize("name", ["codesys", "twincat"])
def test_the_dialects_accept_the_same(name: str) -> None:
    compile_text(CONFIGURED, dialect=dialect_of(name))


def test_the_line_of_an_output_is_in_the_file_of_its_function_block(tmp_path: Path) -> None:
    (tmp_path / "Pump.st").write_text(PUMP)
    (tmp_path / "Main.st").write_text("PROGRAM Main VAR a : Pump; END_VAR a(on := TRUE); END_PROGRAM")
    made: Any = load_program(str(tmp_path))
    scan(made)
    assert str(made.last_assignment("a.run")[0]) == f"{tmp_path / 'Pump.st'}:6"
