"""VAR_CONFIG gives each program of a configuration its own addresses and initial values (IEC 61131-3:2013, 6.8.2)."""

from __future__ import annotations

from typing import Any

import pytest
from st_bench import program, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.dialects import DIALECTS
from fieldtwin.plc.st.program import instance_of, program_class
from fieldtwin.plc.st.project import compile_source

PUMPS = """FUNCTION_BLOCK Motor
VAR_INPUT on : BOOL; END_VAR
VAR run AT %Q* : BOOL; ready AT %I* : BOOL; starts AT %M* : INT; END_VAR
VAR edge : R_TRIG; END_VAR
  edge(CLK := on);
  IF edge.Q THEN starts := starts + 1; END_IF
  run := on AND ready;
END_FUNCTION_BLOCK
PROGRAM Pump
VAR
  start AT %I* : BOOL; lamp AT %Q* : BOOL; level AT %Q* : INT; scans : INT; limit : INT := 1; motor : Motor;
END_VAR
  scans := scans + 1; level := scans * limit; lamp := start; motor(on := start);
END_PROGRAM
CONFIGURATION Plant
  RESOURCE Res0 ON PLC
    TASK fast(INTERVAL := T#10ms, PRIORITY := 1);
    TASK slow(INTERVAL := T#100ms, PRIORITY := 2);
    PROGRAM east WITH fast : Pump;
    PROGRAM west WITH slow : Pump;
    PROGRAM spare : Pump;
  END_RESOURCE
  VAR_CONFIG
    Res0.east.start AT %IX0.0 : BOOL; Res0.east.lamp AT %QX0.0 : BOOL; Res0.east.level AT %QW10 : INT;
    Res0.east.limit : INT := 10; Res0.east.motor.run AT %QX1.0 : BOOL; Res0.east.motor.starts AT %MW0 : INT := 100;
    Res0.west.start AT %IX0.1 : BOOL; Res0.west.lamp AT %QX0.1 : BOOL; Res0.west.level AT %QW11 : INT;
    Res0.west.limit : INT := 20; Res0.west.motor.run AT %QX1.1 : BOOL; Res0.west.motor.ready AT %IX1.1 : BOOL;
  END_VAR
END_CONFIGURATION
"""


def made(text: str, *names: str, dialect: str = "standard") -> list[Any]:
    together: dict[Any, Any] = {}
    return [type(program(text, name, dialect))(together) for name in names]  # type: ignore[call-arg]


def addresses(one: Any) -> dict[str, str]:
    return {v.name: v.address for v in one.variables.values() if v.address}


@pytest.mark.parametrize("dialect", ["standard", "matiec", "codesys"])
def test_each_program_has_its_own_addresses_and_initial_values(dialect: str) -> None:
    east, west, spare = made(PUMPS, "east", "west", "spare", dialect=dialect)
    assert addresses(east) == {
        "start": "%IX0.0", "lamp": "%QX0.0", "level": "%QW10", "motor.run": "%QX1.0", "motor.starts": "%MW0",
    }  # fmt: skip
    assert addresses(west) == {
        "start": "%IX0.1", "lamp": "%QX0.1", "level": "%QW11", "motor.run": "%QX1.1", "motor.ready": "%IX1.1",
    }  # fmt: skip
    assert addresses(spare) == {}
    assert (east.limit, west.limit, spare.limit) == (10, 20, 1)
    values = east.__dict__
    assert values["motor.starts"] == 100
    for one in (east, west, spare):
        scan(one)
    assert (east.level, west.level, spare.level) == (10, 20, 1)
    east.start = True
    scan(east, 2)
    scan(west, 2)
    assert (east.lamp, west.lamp, values["motor.starts"], west.internal("motor.starts").value) == (True, False, 101, 0)


def test_machine_code_has_the_values_of_each_program(tmp_path: Any) -> None:
    (tmp_path / "pumps.st").write_text(PUMPS)
    unit = compile_source(tmp_path / "pumps.st", DIALECTS["standard"], machine_code=True)
    assert unit.machine_code is not None
    together: dict[Any, Any] = {}
    east, west, spare = (program_class(unit, name)(together) for name in ("east", "west", "spare"))
    for number in range(1, 4):
        for one in (east, west, spare):
            scan(one, number)
    assert [one.__dict__["level"] for one in (east, west, spare)] == [30, 60, 3]
    assert east.__dict__["motor.starts"] == 100


def test_the_program_has_the_name_of_its_type_and_its_own_task() -> None:
    (west,) = made(PUMPS, "WEST")
    found = instance_of(west.st_unit, "west")
    assert found is not None
    assert found.task is not None
    assert (type(west).__name__, found.task.name) == ("Pump", "slow")
    assert west.st_unit.kinds.count("program") == 1


def test_the_type_does_not_say_which_program_is_meant() -> None:
    with pytest.raises(FileInvalid, match=r"which program of the configuration is meant.*expected east, west"):
        program(PUMPS, "Pump")


def test_a_value_for_one_program_is_none_for_the_others() -> None:
    text = PUMPS[: PUMPS.index("VAR_CONFIG")]
    east, west = made(text + "VAR_CONFIG east.limit : INT := 7; END_VAR END_CONFIGURATION", "east", "west")
    assert (east.limit, west.limit) == (7, 1)


def test_programs_at_one_address_share_a_variable() -> None:
    text = PUMPS.replace("%IX0.1", "%IX0.0").replace("%QW11 ", "%QW10 ")
    east, west = made(text, "east", "west")
    east.start = True
    scan(east)
    scan(west)
    east.st_show()
    assert (east.level, west.level, west.lamp) == (20, 20, True)


def test_a_program_shares_its_address_with_a_global_variable() -> None:
    text = PUMPS.replace(
        "CONFIGURATION Plant", "CONFIGURATION Plant VAR_GLOBAL east_level AT %QW10 : INT := 4; END_VAR"
    )
    text += (
        "PROGRAM Look VAR seen : INT; END_VAR VAR_EXTERNAL east_level : INT; END_VAR seen := east_level; END_PROGRAM"
    )
    east, west, look = made(text, "east", "west", "Look")
    assert (east.level, west.level) == (4, 0)
    scan(east)
    scan(look)
    assert (look.seen, east.level) == (10, 10)


def test_all_programs_of_a_type_use_one_variable_at_an_address_of_the_type() -> None:
    text = PUMPS[: PUMPS.index("VAR_CONFIG")].replace("lamp AT %Q*", "lamp AT %QX5.0") + "END_CONFIGURATION"
    east, west = made(text, "east", "west")
    east.start = True
    scan(east)
    west.st_show()
    assert (east.lamp, west.lamp) == (True, True)


def test_the_programs_of_a_dialect_with_paths_by_program_have_these_values_too() -> None:
    text = PUMPS.replace("VAR_CONFIG", "VAR_CONFIG Pump.scans : INT := 5;")
    east, spare = made(text, "east", "spare", dialect="codesys")
    assert (east.scans, east.limit, spare.scans, spare.limit) == (5, 10, 5, 1)


def test_a_chart_runs_in_each_program() -> None:
    text = """PROGRAM Main
VAR limit : INT; n : INT; END_VAR
  INITIAL_STEP Idle: END_STEP
  STEP Full: END_STEP
  TRANSITION FROM Idle TO Full := n >= limit; END_TRANSITION
  TRANSITION FROM Full TO Idle := FALSE; END_TRANSITION
END_PROGRAM
CONFIGURATION c PROGRAM a : Main; PROGRAM b : Main;
VAR_CONFIG a.limit : INT := 1; b.limit : INT := 0; END_VAR END_CONFIGURATION"""
    a, b = made(text, "a", "b")
    for number in (1, 2, 3):
        scan(a, number)
        scan(b, number)
    assert [one.internal("Full.X").value for one in (a, b)] == [False, True]
    assert [name for name, _ in b.drawings()] == ["Main"]


def test_each_error_is_reported_once_and_names_the_type() -> None:
    text = PUMPS.replace("lamp := start;", "lamp := 3;")
    with pytest.raises(FileInvalid) as error:
        compile_text(text, "test.st")
    assert [str(one) for one in error.value.others] == []
    text = PUMPS.replace("west WITH slow : Pump", "west WITH slow : Pump(q := 3)")
    with pytest.raises(FileInvalid, match=r"Pump has no input 'q'") as error:
        compile_text(text, "test.st")
    assert error.value.others == ()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("west.limit : INT := 20", "west.limit : INT := 'a'", r"test.st:27:\d+: .*expected INT"),
        ("west.limit : INT", "west.limt : INT", "VAR_CONFIG Res0.west.limt: Pump has no such variable"),
        ("west.lamp AT %QX0.1", "west.lamp AT %IX0.1", "VAR_CONFIG Res0.west.lamp: lamp cannot get the address %IX0.1"),
        ("west.limit : INT := 20", "east.limit : INT := 20", "VAR_CONFIG Res0.east.limit: it has a value already"),
        ("west.motor.run AT %QX1.1", "west.motor.run AT %QX1.0", "%QX1.0 is the address of another variable"),
        ("Res0.west.limit", "Res1.west.limit", "VAR_CONFIG Res1.west.limit: no resource Res1; expected Res0"),
    ],
)
def test_a_mistake_is_refused_at_its_line(old: str, new: str, said: str) -> None:
    with pytest.raises(FileInvalid, match=said):
        compile_text(PUMPS.replace(old, new), "test.st")
