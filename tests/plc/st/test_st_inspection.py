"""The variables of a running program that are not tags: their paths, types and present values."""

from __future__ import annotations

import pytest
from st_bench import program, scan

from fieldtwin.plc.program import InternalVariable, Program, ScanInfo

SOURCE = """
TYPE Mode : (off, slow, fast); END_TYPE
TYPE Pump : STRUCT hours : ARRAY[1..3] OF INT; name : STRING[10]; mode : Mode; END_STRUCT; END_TYPE
FUNCTION_BLOCK Filter
VAR_INPUT x : REAL; END_VAR
VAR_OUTPUT mean : REAL; END_VAR
VAR_IN_OUT count : INT; END_VAR
VAR since : TIME; delay : TON; END_VAR
VAR_TEMP now : INT; END_VAR
  delay(IN := TRUE, PT := T#1s500ms);
  since := delay.ET; mean := x; count := count + 1;
END_FUNCTION_BLOCK
PROGRAM Main
VAR_OUTPUT shown : INT; END_VAR
VAR
  filter : Filter; pumps : ARRAY[2..3] OF Pump; grid : ARRAY[0..1, -1..1] OF INT; many : ARRAY[1..100] OF BOOL;
  calls : INT; day : DATE := D#2026-11-29; text : STRING := 'it runs';
END_VAR
  filter(x := 2.5, count := calls);
  pumps[2].hours[3] := 7; pumps[3].mode := fast; pumps[3].name := 'P3';
  grid[1, -1] := 4;
END_PROGRAM
"""


def running() -> Program:
    made = program(SOURCE)
    scan(made, 1, ms=0)
    scan(made, 2, ms=1000)
    return made


def test_every_member_has_a_path_and_no_tag_is_repeated() -> None:
    names = list(running().internal_names())
    assert names == [
        *("filter.x", "filter.mean", "filter.since"),
        *("filter.delay.IN", "filter.delay.PT", "filter.delay.Q", "filter.delay.ET"),
        *("pumps[2].hours", "pumps[2].name", "pumps[2].mode", "pumps[3].hours", "pumps[3].name", "pumps[3].mode"),
        *("grid", "many", "text"),
    ]


@pytest.mark.parametrize(
    ("path", "type_", "value"),
    [
        ("filter.mean", "REAL", 2.5),
        ("FILTER.Delay.et", "TIME", 1_000_000_000),
        ("filter.since", "TIME", 1_000_000_000),
        ("pumps[2].hours", "ARRAY[1..3] OF INT", "[0, 0, 7]"),
        ("pumps[2].hours[3]", "INT", 7),
        ("pumps[3].mode", "Mode", "fast"),
        ("pumps[ 3 ].name", "STRING[10]", "'P3'"),
        ("grid", "ARRAY[0..1, -1..1] OF INT", "[0, 0, 0, 4, 0, 0]"),
        ("grid[1,-1]", "INT", 4),
        ("many", "ARRAY[1..100] OF BOOL", "[False, False, False, False, False, False, ... 100 elements]"),
        ("text", "STRING[80]", "'it runs'"),
    ],
)
def test_a_variable_is_found_by_its_path(path: str, type_: str, value: object) -> None:
    assert running().internal(path) == InternalVariable(path, type_, value)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "path",
    [
        *("", "filter", "filter.", "filter.now", "filter.count", "filter.x.y", "pumps[2]", "pumps[4].name", "grid[1]"),
        *("grid[0,2]", "text[1]", "shown", "calls", "pumps[2]name", "pumps[2", "grid[x]", "filter..x"),
    ],
)
def test_any_other_path_names_nothing(path: str) -> None:
    assert running().internal(path) is None


def test_every_listed_name_is_found() -> None:
    made = running()
    assert all(made.internal(name) is not None for name in made.internal_names())


def test_a_python_program_has_the_members_of_its_blocks() -> None:
    from fieldtwin.plc.blocks import SECOND, TON

    class Delayed(Program):
        def __init__(self) -> None:
            self.delay = TON()

        def execute(self, scan: ScanInfo) -> None:
            self.delay(scan.now_ns, IN=True, PT=2 * SECOND)

    made = Delayed()
    made.execute(ScanInfo(0, 1, True))
    made.execute(ScanInfo(SECOND, 2, False))
    assert list(made.internal_names()) == ["delay.IN", "delay.PT", "delay.Q", "delay.ET"]
    assert made.internal("delay.ET") == InternalVariable("delay.ET", "TIME", SECOND)
    assert made.internal("delay.et") is made.internal("delay") is made.internal("other.ET") is None
