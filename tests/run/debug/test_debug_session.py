"""A debug session over the Debug Adapter Protocol, with the command as a process and a client on its pipes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from debug_editor import Open, ProcessEditor

SOURCE = """TYPE States : (IDLE, RUN); END_TYPE
FUNCTION Twice : INT
VAR_INPUT x : INT; END_VAR
  Twice := 2 * x;
END_FUNCTION
FUNCTION_BLOCK Counter
VAR_INPUT go : BOOL; END_VAR
VAR_OUTPUT n : INT; state : States; END_VAR
VAR timer : TON; last : ARRAY[1..3] OF INT; END_VAR
  timer(IN := go, PT := T#5s);
  IF go THEN
    n := n + 1;
    state := RUN;
    last[2] := Twice(n);
  END_IF
END_FUNCTION_BLOCK
"""
TESTS = """VAR_GLOBAL limit : INT := 7; END_VAR
TEST 'counts'
VAR c : Counter; zero : INT; END_VAR
  c(go := TRUE);
  ADVANCE_TIME(T#1s500ms);
  c();
  ASSERT_EQ(c.n, 2);
  ASSERT_LT(c.n, limit);
END_TEST
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    (tmp_path / "counter.st").write_text(SOURCE)
    (tmp_path / "counter.test.st").write_text(TESTS)
    return tmp_path


@pytest.fixture
def editor(opened: Open, project: Path) -> ProcessEditor:
    return opened(str(project / "counter.test.st"))


def test_a_breakpoint_stops_with_the_call_stack_and_the_variables(editor: ProcessEditor, project: Path) -> None:
    editor.begin({project / "counter.st": [4]})
    stopped = editor.wait("stopped")
    assert (stopped["reason"], stopped["description"]) == ("breakpoint", "at 0.000 s")
    frames = editor.ask("stackTrace", threadId=1)["stackFrames"]
    assert [(frame["name"], frame["line"], frame["source"]["name"]) for frame in frames] == [
        ("Twice", 4, "counter.st"),
        ("Counter", 14, "counter.st"),
        ("counts", 4, "counter.test.st"),
    ]
    local, _ = editor.ask("scopes", frameId=1)["scopes"]
    variables = editor.ask("variables", variablesReference=local["variablesReference"])["variables"]
    assert [(v["name"], v["value"], v["type"]) for v in variables] == [("x", "1", "INT"), ("Twice", "0", "INT")]
    assert editor.ends() == 0


def test_members_elements_and_global_variables_are_listed(editor: ProcessEditor, project: Path) -> None:
    editor.begin({project / "counter.test.st": [7]})
    editor.wait("stopped")
    scopes = editor.ask("scopes", frameId=1)["scopes"]
    assert [scope["name"] for scope in scopes] == ["counts", "Globals"]
    globals_ = editor.ask("variables", variablesReference=scopes[1]["variablesReference"])["variables"]
    assert [(v["name"], v["value"]) for v in globals_] == [("limit", "7")]
    counter, _ = editor.ask("variables", variablesReference=scopes[0]["variablesReference"])["variables"]
    assert (counter["name"], counter["value"]) == ("c", "Counter")
    members = editor.ask("variables", variablesReference=counter["variablesReference"])["variables"]
    assert {v["name"]: v["value"] for v in members} == {
        "go": "TRUE", "n": "2", "state": "RUN", "timer": "TON", "last": "[0, 4, 0]",
    }  # fmt: skip
    timer = next(v for v in members if v["name"] == "timer")
    inside = editor.ask("variables", variablesReference=timer["variablesReference"])["variables"]
    assert {v["name"]: v["value"] for v in inside} == {"IN": "TRUE", "PT": "T#5s", "Q": "FALSE", "ET": "T#1s500ms"}
    assert [editor.value(path) for path in ("c.last[2]", "C.TIMER.et", "limit")] == ["4", "T#1s500ms", "7"]
    wrong = editor.request("evaluate", expression="c.nothing", frameId=1)
    assert not wrong["success"]
    assert wrong["message"].startswith("c.nothing: in Counter, a member 'nothing' is not declared")
    assert editor.ends() == 0


def test_steps_go_over_into_and_out_of_calls(editor: ProcessEditor, project: Path) -> None:
    editor.begin({project / "counter.st": [12]})
    editor.wait("stopped")
    seen = [editor.place()]
    for command in ("next", "next", "stepIn", "stepOut", "next"):
        editor.ask(command, threadId=1)
        assert editor.wait("stopped")["reason"] == "step"
        seen.append(editor.place())
    assert seen == [
        ("Counter", 12), ("Counter", 13), ("Counter", 14), ("Twice", 4), ("counts", 5), ("counts", 6),
    ]  # fmt: skip
    assert editor.ends() == 0


def test_a_step_into_a_block_stops_at_its_first_statement(editor: ProcessEditor, project: Path) -> None:
    (placed,) = editor.begin({project / "counter.test.st": [4]})
    assert placed["line"] == 4
    editor.wait("stopped")
    editor.goes_on("stepIn")
    assert editor.place() == ("Counter", 10)
    # a breakpoint at a comment or a blank line moves to a statement, and one at the name of a block stops at each call of it
    moved = editor.breakpoints(project / "counter.st", 5, 6)
    assert [one["line"] for one in moved] == [10, 6]
    editor.goes_on()
    assert editor.place() == ("Counter", 6)
    assert editor.ends() == 0


def test_the_answer_to_a_step_comes_before_its_stop(project: Path, opened: Open) -> None:
    """Kate takes a program for running if the answer comes after the stop."""
    (project / "long.test.st").write_text(
        "TEST 'long'\nVAR n : DINT; END_VAR\n  WHILE n < 1000 DO\n    n := n + 1;\n  END_WHILE\nEND_TEST\n"
    )
    editor = opened(str(project / "long.test.st"))
    editor.begin({}, stopOnEntry=True)
    early = len(editor.events)
    editor.wait("stopped")
    for command in ("next", "stepIn") * 150:
        editor.ask(command, threadId=1)
        early += len(editor.events)
        editor.wait("stopped")
    assert early == 0
    editor.ask("terminate")
    assert not editor.events
    editor.wait("terminated")
    assert editor.ends() == 0


def test_a_step_over_a_call_executes_the_whole_line(editor: ProcessEditor, project: Path) -> None:
    editor.begin({project / "counter.test.st": [4]})  # a call with an argument: several instructions in one line
    editor.wait("stopped")
    seen = []
    for _ in range(3):
        editor.ask("next", threadId=1)
        editor.wait("stopped")
        seen.append(editor.place())
    assert seen == [("counts", 5), ("counts", 6), ("counts", 7)]
    assert editor.ends() == 0


def test_a_breakpoint_moves_to_the_next_statement_and_stops_once_in_each_call(
    editor: ProcessEditor, project: Path
) -> None:
    editor.ask("initialize", adapterID="fieldtwin")
    editor.ask("launch")
    source = {"path": str(project / "counter.st")}
    answer = editor.ask("setBreakpoints", source=source, breakpoints=[{"line": 9}, {"line": 400}])
    assert [(one["verified"], one["line"]) for one in answer["breakpoints"]] == [(True, 10), (False, 400)]
    foreign = editor.ask("setBreakpoints", source={"path": "/other.st"}, breakpoints=[{"line": 1}])
    assert foreign["breakpoints"][0]["message"] == "this file is not part of the program"
    editor.ask("configurationDone")
    times = []
    for _ in range(2):
        times.append(editor.wait("stopped")["description"])
        editor.ask("continue", threadId=1)
    assert times == ["at 0.000 s", "at 1.500 s"]
    assert editor.wait("exited") == {"exitCode": 0}
    assert editor.ends() == 0


def test_the_result_of_the_tests_is_shown(editor: ProcessEditor) -> None:
    editor.begin({})
    assert editor.wait("output")["output"] == "passed  counts  1.5 s\n"
    assert editor.wait("exited") == {"exitCode": 0}
    assert editor.ends() == 0


def test_a_test_without_an_assertion_is_inconclusive(project: Path, opened: Open) -> None:
    (project / "empty.test.st").write_text("TEST 'empty'\nVAR n : INT; END_VAR\n  n := 1;\nEND_TEST\n")
    editor = opened(str(project / "empty.test.st"))
    editor.begin({})
    shown = [editor.wait("output")["output"] for _ in range(2)]
    assert shown == ["inconclusive  empty  0 s\n", "  the test executed no assertion\n"]
    assert editor.wait("exited") == {"exitCode": 1}
    assert editor.ends() == 0


def test_a_method_shows_its_variables_and_those_of_its_block(project: Path, opened: Open) -> None:
    (project / "tank.st").write_text(
        "FUNCTION_BLOCK Tank\nVAR level : INT := 3; END_VAR\nMETHOD PUBLIC Fill : INT\nVAR_INPUT by : INT; END_VAR\n"
        "  level := level + by;\n  Fill := level;\nEND_METHOD\nEND_FUNCTION_BLOCK\n"
    )
    (project / "tank.test.st").write_text(
        "TEST 'fills'\nVAR t : Tank; n : INT; END_VAR\n  n := t.Fill(by := 4);\n  ASSERT_EQ(n, 7);\nEND_TEST\n"
    )
    editor = opened(str(project / "tank.test.st"))
    editor.begin({project / "tank.st": [6]})
    editor.wait("stopped")
    assert editor.place() == ("Tank.Fill", 6)
    assert [editor.value(path) for path in ("by", "level", "Fill")] == ["4", "7", "0"]
    assert editor.ends() == 0


def test_an_error_in_a_scan_stops_at_its_line(project: Path, opened: Open) -> None:
    (project / "bad.test.st").write_text("TEST 'bad'\nVAR n : INT; END_VAR\n  n := 0;\n  n := 1 / n;\nEND_TEST\n")
    editor = opened(str(project / "bad.test.st"))
    editor.begin({})
    stopped = editor.wait("stopped")
    assert (stopped["reason"], stopped["text"]) == ("exception", "division by zero")
    assert editor.place() == ("bad", 4)
    editor.ask("continue", threadId=1)
    assert "division by zero" in [editor.wait("output")["output"] for _ in range(2)][1]
    assert editor.wait("exited") == {"exitCode": 1}
    assert editor.ends() == 0


FAILING = """FUNCTION Half : INT
VAR_INPUT of : INT; END_VAR
  Half := of / 2;
END_FUNCTION
TEST 'halves'
VAR i, halved : INT; END_VAR
  FOR i := 1 TO 4 DO
    halved := Half(i);
    ASSERT_EQ(halved, 0, 'all are small');
  END_FOR
  ASSERT_TRUE(i > 9);
END_TEST
"""


def test_a_failed_assertion_stops_at_its_line(project: Path, opened: Open) -> None:
    (project / "half.test.st").write_text(FAILING)
    editor = opened(str(project / "half.test.st"))
    editor.begin({}, filters=["errors", "assertions"])
    stopped = editor.wait("stopped")
    text = "all are small: ASSERT_EQ(halved, 0): expected 0, got 1"
    assert (stopped["reason"], stopped["text"]) == ("exception", text)
    assert editor.place() == ("halves", 9)
    assert editor.value("i") == "2"
    assert editor.goes_on()["text"] == "ASSERT_TRUE(i > 9): expected TRUE, got FALSE"  # each assertion stops once
    editor.ask("continue", threadId=1)
    lines = [editor.wait("output")["output"] for _ in range(2)]
    assert lines == ["failed  halves  0 s\n", f"  {text} ({project / 'half.test.st'}:9, at 0.000 s)\n"]
    assert editor.wait("exited") == {"exitCode": 1}
    assert editor.ends() == 0


def test_steps_and_ends_after_a_failed_assertion(project: Path, opened: Open) -> None:
    (project / "half.test.st").write_text(FAILING)
    editor = opened(str(project / "half.test.st"))
    editor.begin({}, filters=["assertions"])
    editor.wait("stopped")
    assert editor.goes_on("next")["reason"] == "step"
    assert editor.place() == ("halves", 7)
    editor.ask("setExpression", expression="i", value="1", frameId=1)
    editor.ask("continue", threadId=1)
    assert editor.wait("stopped")["reason"] == "exception"
    editor.ask("terminate")
    editor.wait("terminated")
    assert editor.ends() == 0


def test_a_failed_assertion_does_not_stop_if_the_editor_has_not_chosen_it(project: Path, opened: Open) -> None:
    (project / "half.test.st").write_text(FAILING)
    editor = opened(str(project / "half.test.st"))
    editor.begin({}, filters=[])
    while (event := editor.event())["event"] != "exited":
        assert event["event"] == "output"
    assert editor.ends() == 0


def test_each_variable_names_an_expression_for_a_watch(editor: ProcessEditor, project: Path) -> None:
    editor.begin({project / "counter.test.st": [7]})
    editor.wait("stopped")
    seen: dict[str, str] = {}
    constant: set[str] = set()

    def visit(reference: int) -> None:
        for one in editor.ask("variables", variablesReference=reference)["variables"]:
            seen[one["evaluateName"]] = one["value"]
            if "readOnly" in one.get("presentationHint", {}).get("attributes", ()):
                constant.add(one["evaluateName"])
            if one["variablesReference"]:
                visit(one["variablesReference"])

    for scope in editor.ask("scopes", frameId=1)["scopes"]:
        visit(scope["variablesReference"])
    assert {"c", "c.timer", "c.timer.ET", "c.last[2]", "zero", "limit"} < set(seen)
    assert {path: editor.value(path) for path in seen} == seen
    assert constant == {"c.timer.Q", "c.timer.ET"}
    assert editor.ends() == 0


def test_a_source_with_an_error_is_a_failed_launch(project: Path, opened: Open) -> None:
    (project / "bad.test.st").write_text("TEST 'bad'\n  nothing := 1;\nEND_TEST\n")
    editor = opened()
    editor.ask("initialize", adapterID="fieldtwin")
    answer = editor.request("launch", program=str(project / "bad.test.st"))
    assert not answer["success"]
    assert "bad.test.st:2:3: a variable 'nothing' is not declared" in answer["message"]
    shown = editor.wait("output")
    assert (shown["category"], shown["source"]["name"], shown["line"]) == ("stderr", "bad.test.st", 2)
    assert shown["output"].rstrip() in answer["message"]
    assert editor.ends() == 0


def test_an_endless_program_is_paused_and_ended(project: Path, opened: Open) -> None:
    (project / "long.test.st").write_text(
        "TEST 'long'\nVAR n : DINT; END_VAR\n  WHILE TRUE DO\n    n := n + 1;\n    ADVANCE_TIME(T#1ms);\n  END_WHILE\nEND_TEST\n"
    )
    editor = opened(str(project / "long.test.st"))
    editor.begin({})
    editor.ask("pause", threadId=1)
    assert editor.wait("stopped")["reason"] == "pause"
    assert int(editor.value("n")) >= 0
    assert editor.ends() == 0


def test_requests_at_the_wrong_time_and_bad_messages_are_answered(editor: ProcessEditor) -> None:
    assert "not supported: fly" in editor.bad_request("fly")["message"]
    assert "the program is not stopped" in editor.request("continue", threadId=1)["message"]
    assert "the arguments of setBreakpoints" in editor.bad_request("setBreakpoints")["message"]
    assert "these variables no longer exist" in editor.request("variables", variablesReference=3)["message"]
    editor.send(b"[]")
    assert editor.process.wait(20) == 2
    assert editor.process.stderr is not None
    assert b"a message that is not a JSON object" in editor.process.stderr.read()


def test_the_programs_of_a_system_stop_in_virtual_time(opened: Open) -> None:
    editor = opened("lab_vehicle", "--for", "5s")
    program = Path(__file__).parents[3] / "profiles" / "systems" / "vehicle.st"
    editor.begin({program: [45]})
    stopped = editor.wait("stopped")
    assert stopped["reason"] == "breakpoint"
    assert editor.place() == ("Vehicle", 45)
    assert editor.value("driving") == "FALSE"
    # nothing changes, but no scan passes by the breakpoint
    editor.breakpoints(program, {"line": 45, "hitCondition": "40"})
    assert (stopped["description"], editor.goes_on()["description"]) == ("at 0.180 s", "at 0.980 s")  # 40 x 20 ms
    editor.breakpoints(program)
    editor.ask("continue", threadId=1)
    assert editor.wait("exited") == {"exitCode": 0}
    assert editor.ends() == 0


def test_an_editor_can_connect_to_a_port(project: Path) -> None:
    import socket

    command = [sys.executable, "-m", "fieldtwin", "plc", "debug", str(project / "counter.test.st"), "--port", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, env={**os.environ, "NO_COLOR": "1"}) as process:
        assert process.stderr is not None
        port = int(process.stderr.readline().rsplit(b":", 1)[1])
        with socket.create_connection(("127.0.0.1", port)) as connection, connection.makefile("rb") as stream:
            data = json.dumps({"seq": 1, "type": "request", "command": "initialize"}).encode()
            connection.sendall(b"Content-Length: %d\r\n\r\n" % len(data) + data)
            assert stream.readline().startswith(b"Content-Length: ")
        assert process.wait(20) == 0
