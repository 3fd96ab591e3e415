"""Breakpoints with conditions and hit counts, logpoints, new values of variables, and expressions in Structured Text."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from debug_editor import Editor, editor_on_socket

from fieldtwin.plc.st.dialects import STANDARD, dialect_of
from fieldtwin.run.debug.programs import unit_tests

SOURCE = """FUNCTION Twice : INT
VAR_INPUT x : INT; END_VAR
VAR two : INT := 2; more : ARRAY[1..2] OF INT := [3, 4]; END_VAR
VAR CONSTANT top : INT := 9; END_VAR
  Twice := two * x;
  Twice := MIN(Twice, 100);
END_FUNCTION
FUNCTION Grow : INT
VAR_IN_OUT of : INT; END_VAR
  of := of + 1;
  Grow := of;
END_FUNCTION
FUNCTION Touch : INT
VAR_EXTERNAL total : INT; END_VAR
  total := total + 1;
  Touch := total;
END_FUNCTION
FUNCTION_BLOCK Counter
VAR_INPUT by : INT; END_VAR
VAR_OUTPUT n : INT; END_VAR
VAR timer : TON; last : ARRAY[1..2, 0..1] OF INT; word : BYTE; small : INT(0..50); text : STRING[5]; END_VAR
METHOD PUBLIC Add : INT
VAR_INPUT much : INT; END_VAR
  n := n + much;
  Add := n;
END_METHOD
  timer(IN := TRUE, PT := T#5s);
  n := n + by;
  last[2, 1] := Twice(n);
  word := INT_TO_BYTE(n);
  n := n;
END_FUNCTION_BLOCK
"""
TEST = """VAR_GLOBAL total : INT; END_VAR
TEST 'counts'
VAR c : Counter; i, zero : INT; END_VAR
  FOR i := 1 TO 10 DO
    c(by := 1);
    ADVANCE_TIME(T#1s);
  END_FOR
  i := c.Add(5);
  ASSERT_EQ(c.n, 15);
  i := Grow(zero) + Touch();
END_TEST
"""
ADDS = 28
"""The line ``n := n + by`` of the block."""


HALF = """FUNCTION_BLOCK Cell
VAR n : INT; END_VAR
METHOD PUBLIC Add : INT
VAR_INPUT much : INT; END_VAR
VAR_INST calls : INT; END_VAR
  calls := calls + 1;
  n := n + much;
  Add := n;
END_METHOD
PROPERTY Half : INT
GET
  Half := n / 2;
END_GET
END_PROPERTY
END_FUNCTION_BLOCK
TEST 'halves'
VAR c : Cell; i : INT; END_VAR
  i := c.Add(5);
  i := c.Half;
  ASSERT_EQ(i, 2);
END_TEST
"""
HALF_CALLS = 18


@pytest.fixture
def project(tmp_path: Path) -> Path:
    (tmp_path / "counter.st").write_text(SOURCE)
    (tmp_path / "counter.test.st").write_text(TEST)
    return tmp_path


@pytest.fixture
def editor(project: Path) -> Iterator[Editor]:
    with editor_on_socket(lambda _: unit_tests(project / "counter.test.st", STANDARD, ())) as one:
        yield one


def stops(editor: Editor, project: Path, **conditions: str) -> list[str]:
    """Return the values of n at each stop at the line ``n := n + by``."""
    (placed,) = editor.begin({project / "counter.st": [{"line": ADDS, **conditions}]})
    assert placed == {"verified": True, "line": ADDS}
    found = []
    while (event := editor.event())["event"] != "exited":
        if event["event"] == "stopped":
            found.append(editor.value("n"))
            editor.ask("continue", threadId=1)
    return found


@pytest.mark.parametrize(
    ("conditions", "values"),
    [
        ({"condition": "n >= 8"}, ["8", "9"]),
        ({"condition": "n MOD 4 = 1 AND timer.ET > T#2s"}, ["5", "9"]),
        ({"condition": "Twice(n) = 6"}, ["3"]),
        ({"condition": "last[2, 1] = 4"}, ["2"]),
        ({"hitCondition": "3"}, ["2"]),
        ({"hitCondition": ">= 9"}, ["8", "9"]),
        ({"hitCondition": "> 9"}, ["9"]),
        ({"hitCondition": "% 4"}, ["3", "7"]),
        ({"condition": "n > 4", "hitCondition": "= 2"}, ["6"]),
    ],
)
def test_a_breakpoint_stops_where_its_conditions_hold(
    editor: Editor, project: Path, conditions: dict[str, str], values: list[str]
) -> None:
    assert stops(editor, project, **conditions) == values


@pytest.mark.parametrize(
    ("one", "message"),
    [
        ({"condition": "n + 1"}, "n + 1: types differ; expected BOOL; got INT"),
        ({"condition": "m > 1"}, "m > 1: a variable 'm' is not declared"),
        ({"condition": "n >"}, "n >: "),
        ({"condition": "Add(much := 1) > 1"}, "a method in an expression of the debugger"),
        ({"condition": "Grow(n) > 1"}, "the function Grow in an expression of the debugger may change variables"),
        ({"condition": "Touch() > 1"}, "the function Touch in an expression of the debugger may change variables"),
        ({"condition": "n" + " + n" * 500 + " = 1"}, "an expression that is too long"),
        ({"hitCondition": "often"}, "the hit count of a breakpoint; expected 5, >= 5, > 5 or % 5; got often"),
        ({"hitCondition": "% 0"}, "the hit count of a breakpoint"),
        ({"logMessage": "n is {m}"}, "m: a variable 'm' is not declared"),
    ],
)
def test_a_condition_that_is_not_valid_is_refused_with_its_reason(
    editor: Editor, project: Path, one: dict[str, Any], message: str
) -> None:
    (placed,) = editor.begin({project / "counter.st": [{"line": ADDS, **one}]})
    assert not placed["verified"]
    assert message in placed["message"]
    assert editor.wait("exited") == {"exitCode": 0}


def test_a_condition_without_a_value_stops_and_says_why(editor: Editor, project: Path) -> None:
    editor.begin({project / "counter.st": [{"line": ADDS, "condition": "10 / n > 0"}]})
    assert "10 / n > 0 has no value here: division by zero" in editor.wait("stopped")["text"]


def test_a_logpoint_writes_its_message_and_does_not_stop(editor: Editor, project: Path) -> None:
    message = "n is {n}, {10 / n}, {timer.ET} {text}"
    editor.begin({project / "counter.st": [{"line": ADDS, "logMessage": message, "condition": "n < 3"}]})
    first = editor.wait("output")
    assert (first["category"], first["line"]) == ("stdout", ADDS)  # an editor may hide other categories
    assert [first["output"].rstrip(), *(editor.logged() for _ in range(2))] == [
        "at 0.000 s: n is 0, <10 / n has no value here: division by zero>, T#0s ''",
        "at 1.000 s: n is 1, 10, T#1s ''",
        "at 2.000 s: n is 2, 5, T#2s ''",
    ]
    assert editor.logged() == "passed  counts  10 s"


def test_expressions_are_evaluated_in_the_scope_of_the_stopped_block(editor: Editor, project: Path) -> None:
    editor.begin({project / "counter.st": [{"line": ADDS, "condition": "n = 3"}]})
    editor.wait("stopped")
    seen = {
        text: editor.value(text)
        for text in ("n * 2 + 1", "Twice(n)", "n > 2 AND timer.Q", "LEN(text)", "timer.PT - timer.ET")
    }
    assert seen == {
        "n * 2 + 1": "7",
        "Twice(n)": "6",
        "n > 2 AND timer.Q": "FALSE",
        "LEN(text)": "0",
        "timer.PT - timer.ET": "T#2s",
    }
    wrong = editor.request("evaluate", expression="n + TRUE", frameId=1)
    assert not wrong["success"]
    assert "n + TRUE: " in wrong["message"]
    assert editor.ask("evaluate", expression="i", frameId=2)["result"] == "4"


def test_a_new_value_is_used_by_the_program(editor: Editor, project: Path) -> None:
    editor.begin({project / "counter.st": [{"line": ADDS, "condition": "n = 2"}]})
    editor.wait("stopped")
    scope = editor.ask("scopes", frameId=1)["scopes"][0]["variablesReference"]
    answer = editor.ask("setVariable", variablesReference=scope, name="n", value="by + 4")
    assert (answer["value"], answer["type"]) == ("5", "INT")
    assert editor.value("n") == "5"
    for path, value, shown in (
        ("last[1,0]", "7", "7"), ("timer.PT", "T#9s", "T#9s"), ("word", "16#1F", "31"),
        ("text", "'abcdefgh'", "'abcde'"), ("total", "12", "12"), ("small", "n", "5"),
    ):  # fmt: skip
        assert editor.ask("setExpression", expression=path, value=value, frameId=1)["value"] == shown
        assert editor.value(path) == shown
    editor.breakpoints(project / "counter.test.st", 8)
    assert editor.goes_on()["reason"] == "breakpoint"
    assert editor.value("c.n") == "13"  # 10 steps, and 3 more than it had
    assert editor.value("c.last[1,0]") == "7"


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("n", "TRUE", "types differ; expected INT; got BOOL"),
        ("n", "1.5", "types differ"),
        ("small", "60", "types differ; expected INT(0..50); got 60"),
        ("timer.ET", "T#1s", "timer.ET cannot be set here"),
        ("last", "[1]", "last has parts; expected a member or an element of it"),
        ("nothing", "1", "no variable 'nothing' here"),
        ("last[3,0]", "1", "no variable 'last[3,0]' here"),
    ],
)
def test_a_value_that_a_variable_cannot_have_is_refused(
    editor: Editor, project: Path, path: str, value: str, message: str
) -> None:
    editor.begin({project / "counter.st": [ADDS]})
    editor.wait("stopped")
    answer = editor.request("setExpression", expression=path, value=value, frameId=1)
    assert not answer["success"]
    assert message in answer["message"]


def test_a_variable_of_a_function_is_set_only_in_the_frame_that_stopped(editor: Editor, project: Path) -> None:
    editor.begin({project / "counter.st": [5]})
    editor.wait("stopped")
    editor.ask("setExpression", expression="two", value="30", frameId=1)
    assert editor.value("two") == "30"
    refused = editor.request("setExpression", expression="top", value="1", frameId=1)
    assert "cannot be set" in refused["message"] or "no variable" in refused["message"]
    editor.goes_on("next")
    assert editor.value("Twice") == "30"


def test_steps_do_not_stop_at_initial_values_and_a_breakpoint_does(editor: Editor, project: Path) -> None:
    editor.begin({project / "counter.st": [29]})
    editor.wait("stopped")
    editor.goes_on("stepIn")
    assert editor.place() == ("Twice", 5)  # not 1 to 4, with the declarations
    (placed,) = editor.breakpoints(project / "counter.st", 3)
    assert placed == {"verified": True, "line": 3}
    editor.goes_on()
    assert editor.place() == ("Twice", 3)


def test_steps_go_into_methods_and_properties(project: Path) -> None:
    (project / "half.test.st").write_text(HALF)
    with editor_on_socket(lambda _: unit_tests(project / "half.test.st", dialect_of("codesys"), ())) as editor:
        editor.begin({project / "half.test.st": [HALF_CALLS]})
        editor.wait("stopped")
        seen = []
        for command in ("stepIn", "stepOut", "stepIn", "stepOut"):
            editor.goes_on(command)
            seen.append(editor.place())
        assert seen == [("Cell.Add", 6), ("halves", 19), ("Cell.Half", 12), ("halves", 20)]


def test_the_instance_variables_of_a_method_are_shown_with_their_names(project: Path) -> None:
    (project / "half.test.st").write_text(HALF)
    with editor_on_socket(lambda _: unit_tests(project / "half.test.st", dialect_of("codesys"), ())) as editor:
        editor.begin({project / "half.test.st": [{"line": 7, "condition": "calls = 1"}]})
        editor.wait("stopped")
        scope = editor.ask("scopes", frameId=1)["scopes"][0]["variablesReference"]
        shown = {v["name"]: v["value"] for v in editor.ask("variables", variablesReference=scope)["variables"]}
        assert shown == {"n": "0", "much": "5", "calls": "1", "Add": "0"}
        assert editor.value("calls + 1") == "2"
        assert (
            editor.ask("evaluate", expression="c.n * 2", frameId=2)["result"] == "0"
        )  # an inner variable of the block
