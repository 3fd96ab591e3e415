"""Actions of programs and function blocks, in Structured Text (IEC 61131-3, 6.7.4)."""

from __future__ import annotations

import pytest
from st_bench import program, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.compiler.compile import compile_text

TANK = """
FUNCTION_BLOCK Counter
VAR_INPUT step : INT := 1; END_VAR
VAR_OUTPUT n : INT; END_VAR
VAR_TEMP old : INT; END_VAR
  old := n;
  Add();
  IF n > 100 THEN Clear(); END_IF
  ACTION Add:
    n := old + step;
    IF n > 3 THEN RETURN; END_IF
    n := n + 10;
  END_ACTION
  ACTION Clear: n := 0; END_ACTION
END_FUNCTION_BLOCK
PROGRAM Main
VAR_INPUT go : BOOL; END_VAR
VAR_OUTPUT seen : INT; END_VAR
VAR c : ARRAY[0..1] OF Counter; i : INT := 1; END_VAR
  c[i](step := 2);
  IF go THEN c[i].Clear(); END_IF
  Show();
  ACTION Show
    seen := c[1].n;
  END_ACTION
END_PROGRAM
"""


def test_actions_run_in_their_instance_and_share_its_temporary_variables() -> None:
    made = program(TANK)
    seen = []
    for number in range(1, 6):
        made.go = number == 3  # type: ignore[attr-defined]
        scan(made, number)
        seen.append(made.seen)  # type: ignore[attr-defined]
    assert seen == [12, 14, 0, 12, 14]


def test_an_output_that_an_action_assigns_names_its_line() -> None:
    made = program(TANK)
    scan(made, 1)
    place = made.last_assignment("seen")[0]
    assert place is not None
    assert TANK.splitlines()[place.line - 1].strip() == "seen := c[1].n;"


def test_an_action_of_a_block_can_be_called_with_its_inputs_and_in_outs() -> None:
    made = program("""
        FUNCTION_BLOCK Meter
        VAR_INPUT by : INT; END_VAR VAR_IN_OUT sum : INT; END_VAR
          ACTION Add: sum := sum + by; END_ACTION
        END_FUNCTION_BLOCK
        PROGRAM Main VAR_OUTPUT total : INT; END_VAR VAR m : Meter; END_VAR
          m.Add(by := 4, sum := total);
        END_PROGRAM""")
    for number in range(1, 4):
        scan(made, number)
    assert made.total == 12  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("PROGRAM p A(); ACTION A: B(); END_ACTION ACTION B: A(); END_ACTION END_PROGRAM", "calls itself"),
        ("PROGRAM p ACTION A: ; END_ACTION ACTION a: ; END_ACTION END_PROGRAM", "a is declared twice"),
        ("PROGRAM p VAR a : INT; END_VAR ACTION A: ; END_ACTION END_PROGRAM", "A is declared twice"),
        ("PROGRAM p A(1); ACTION A: ; END_ACTION END_PROGRAM", "action A takes no arguments"),
        ("PROGRAM p b(); ACTION A: ; END_ACTION END_PROGRAM", "a function 'b' is not declared"),
        ("FUNCTION f : INT f := 1; ACTION A: ; END_ACTION END_FUNCTION", "got ACTION"),
        (
            "FUNCTION_BLOCK b VAR_IN_OUT x : INT; END_VAR ACTION A: x := 1; END_ACTION END_FUNCTION_BLOCK\n"
            "PROGRAM p VAR i : b; END_VAR i.A(); END_PROGRAM",
            "VAR_IN_OUT x of b needs a variable",
        ),
    ],
)
def test_a_wrong_use_of_actions_is_refused(text: str, told: str) -> None:
    with pytest.raises(FileInvalid) as e:
        compile_text(text, "a.st")
    assert told in str(e.value)
