"""Traces of variables: the ring and its trigger, and the variables of programs in Structured Text after each scan."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.image.image import INPUTS, TagKind, TagSpec
from fieldtwin.gateway.core.values import Quality, TagValue
from fieldtwin.plc.binding import InputBinding, image_for
from fieldtwin.plc.runtime.config import PlcConfig, ProgramConfig, TaskSpec
from fieldtwin.plc.runtime.runner import TaskRunner
from fieldtwin.plc.runtime.tracing import KEPT_NS, MAX_TRACES, RunnerTrace, Traces
from fieldtwin.plc.runtime.variable_trace import (
    MAX_BYTES,
    MAX_SCANS,
    MAX_VARIABLES,
    VALUES_AT_ONCE,
    TracedVariable,
    TraceSize,
    TraceState,
    VariableTrace,
    row_bytes,
)

SOURCE = """VAR_GLOBAL total : DINT; END_VAR
VAR_GLOBAL CONSTANT step : DINT := 2; END_VAR
TYPE Modes : (IDLE, RUN); Cell : STRUCT hours : INT; END_STRUCT; END_TYPE
FUNCTION_BLOCK Control
VAR_INPUT go : BOOL; END_VAR
VAR delay : TON; levels : ARRAY[1..2, 0..1] OF INT; cells : ARRAY[0..1] OF Cell; END_VAR
  delay(IN := go, PT := T#30ms);
  levels[2, 1] := levels[2, 1] + 1;
  cells[1].hours := levels[2, 1];
END_FUNCTION_BLOCK
PROGRAM Main
VAR_INPUT level : REAL; END_VAR
VAR_OUTPUT mode : Modes; END_VAR
VAR control : Control; text : STRING[9] := 'a'; n : INT; END_VAR
  n := n + 1;
  total := total + step;
  mode := Modes#RUN;
  control(go := TRUE);
  IF n = 3 THEN text := 'three'; END_IF
END_PROGRAM
"""
OTHER = """PROGRAM Slow
VAR n : INT; END_VAR
  n := n + 10;
END_PROGRAM
"""


class Rig:
    def __init__(self, folder: Path) -> None:
        (folder / "main.st").write_text(SOURCE)
        (folder / "slow.st").write_text(OTHER)
        programs = (
            ProgramConfig("main", "main.st", {"level": InputBinding("tank.level", "pass")}, task="fast"),
            ProgramConfig("slow", "slow.st", task="slow"),
        )
        bound = [p.bind((str(folder),)) for p in programs]
        layout = image_for(bound, {"tank.level": TagSpec("tank.level", TagKind.REAL, "m")})
        memory = memoryview(bytearray(layout.size))
        layout.format(memory)
        image = layout.attach(memory)
        self.writer = image.writer(INPUTS)
        self.now_ns = 0
        tasks = (TaskSpec("fast", 10), TaskSpec("slow", 30))
        config = PlcConfig("", layout.describe(), "", programs, python_path=(str(folder),), tasks=tasks)
        self.runner = TaskRunner(config, image, lambda: self.now_ns)
        self.runner.start()

    def until_ms(self, ms: int) -> None:
        while self.runner.deadline_ns <= ms * 1_000_000:
            self.now_ns = self.runner.deadline_ns
            self.writer.publish([TagValue(self.now_ns / 1e7, Quality.GOOD, t_ns=self.now_ns)], self.now_ns)
            self.runner.run_once()


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return Rig(tmp_path)


def follow(rig: Rig, names: list[str], size: TraceSize, when: str = "") -> VariableTrace:
    made = RunnerTrace(rig.runner, names, size, when)
    rig.runner.on_scan = lambda entry: made.after_scan(entry, entry.task.began_ns)
    return made.trace


def columns(trace: VariableTrace) -> dict[str, list[Any]]:
    return {v.name: [row.values[n] for row in trace.rows] for n, v in enumerate(trace.variables)}


def test_every_kind_of_variable_is_recorded_after_each_scan(rig: Rig) -> None:
    names = {
        "tank.level": [1.0, 2.0, 3.0, 4.0],
        "main.level": [1.0, 2.0, 3.0, 4.0],
        "main.n": [1, 2, 3, 4],
        "main.mode": ["RUN"] * 4,
        "main.text": ["'a'", "'a'", "'three'", "'three'"],
        "main.total": [2, 4, 6, 8],
        "main.control.delay.ET": [0, 10_000_000, 20_000_000, 30_000_000],
        "main.control.delay.Q": [False, False, False, True],
        "main.control.levels[2,1]": [1, 2, 3, 4],
        "main.Control.Cells[1].hours": [1, 2, 3, 4],
    }
    trace = follow(rig, list(names), TraceSize(10))
    rig.until_ms(40)
    assert columns(trace) == names
    assert [(row.scan, row.t_ns) for row in trace.rows] == [(n, n * 10_000_000) for n in (1, 2, 3, 4)]
    assert {v.name: (v.type, v.unit) for v in trace.variables}["main.control.delay.ET"] == ("TIME", "ns")


def test_a_trace_follows_the_task_of_its_program(rig: Rig) -> None:
    trace = follow(rig, ["slow.n", "main.n"], TraceSize(10))
    rig.until_ms(95)
    assert columns(trace) == {"slow.n": [10, 20, 30], "main.n": [3, 6, 9]}


def test_a_trigger_keeps_the_wanted_scans_before_and_after_it(rig: Rig) -> None:
    trace = follow(rig, ["main.n"], TraceSize(2, 3), "n = 5 AND control.delay.Q")
    states = []
    for n in range(1, 10):
        rig.until_ms(10 * n)
        states.append(trace.state.value[0])
    assert columns(trace) == {"main.n": [3, 4, 5, 6, 7]}
    assert "".join(states) == "wwwwttccc"
    assert [row.values[0] for row in trace.rows if row.number == trace.triggered_row] == [5]


def test_a_trigger_without_a_value_is_reported_and_does_not_fire(rig: Rig) -> None:
    trace = follow(rig, ["main.n"], TraceSize(1, 1), "10 / (n - 2) > 100")
    rig.until_ms(20)
    assert (trace.state, trace.error) == (TraceState.WAITING, "10 / (n - 2) > 100 has no value here: division by zero")
    rig.until_ms(30)
    assert trace.error == ""


def test_a_trace_goes_on_after_a_restart_of_the_programs(rig: Rig) -> None:
    trace = follow(rig, ["main.n"], TraceSize(10))
    rig.until_ms(20)
    rig.runner.restart()
    rig.until_ms(40)
    assert columns(trace) == {"main.n": [1, 2, 1, 2]}


@pytest.mark.parametrize(
    ("names", "size", "when", "message"),
    [
        (["main.m"], TraceSize(5), "", r"no variable 'main.m' that can be traced.*did you mean"),
        (["main.control"], TraceSize(5), "", "no variable 'main.control'"),
        (["main.control.levels[3,1]"], TraceSize(5), "", "no variable"),
        ([], TraceSize(5), "", "the variables of a trace"),
        (["main.n"] * (MAX_VARIABLES + 1), TraceSize(5), "", "1 to 32"),
        (["main.n"], TraceSize(0), "", "the scans of a trace"),
        (["main.n"], TraceSize(MAX_SCANS), "TRUE", "the scans after the trigger"),
        (["main.n"], TraceSize(MAX_SCANS, 1), "TRUE", "the scans of a trace; expected 1 to 100000"),
        (["main.text"] * MAX_VARIABLES, TraceSize(MAX_SCANS), "", "the scans of a trace"),
        (["main.n"], TraceSize(1, 1), "n", "types differ; expected BOOL"),
        (["main.n"], TraceSize(1, 1), "m > 1", "m > 1: a variable 'm' is not declared"),
        (["tank.level"], TraceSize(1, 1), "TRUE", "a condition on variables; expected a variable of a program"),
    ],
)
def test_what_cannot_be_traced_is_refused(rig: Rig, names: list[str], size: TraceSize, when: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        RunnerTrace(rig.runner, names, size, when)


@given(st.lists(st.booleans(), max_size=60), st.integers(0, 8), st.integers(1, 8), st.booleans())
def test_the_ring_holds_what_a_list_of_all_rows_says(
    conditions: list[bool], before: int, after: int, triggers: bool
) -> None:
    at = iter(conditions)
    rows = iter(range(len(conditions)))
    size = TraceSize(before, after) if triggers else TraceSize(before + after)
    trace = VariableTrace(
        [TracedVariable("n", "INT", lambda: next(rows))], size, (lambda: next(at)) if triggers else None
    )
    for n in range(len(conditions)):
        trace.record(n, n)
    every = list(range(len(conditions)))
    if not triggers:
        wanted = every[-before - after :]
    elif True in conditions:
        first = conditions.index(True)
        wanted = every[max(0, first - before) : first + after]
    else:
        wanted = every[-before:] if before else []
    assert [row.values[0] for row in trace.rows] == wanted
    assert (trace.state is TraceState.COMPLETE) == (
        triggers and True in conditions and len(wanted[wanted.index(first) :]) == after
    )


def test_a_ring_stays_below_its_limit_of_memory() -> None:
    texts = [TracedVariable("t", "STRING", lambda: "x", is_text=True)] * MAX_VARIABLES
    most = MAX_BYTES // row_bytes(texts)
    VariableTrace(texts, TraceSize(most))
    with pytest.raises(UsageError, match=f"1 to {most} with these variables"):
        VariableTrace(texts, TraceSize(most + 1))


def test_clients_read_traces_in_pieces_and_unread_ones_are_removed(rig: Rig) -> None:
    traces = Traces(rig.runner, lambda: rig.now_ns)

    def ask(command: Any, **args: Any) -> dict[str, Any]:
        found: dict[str, Any] = asyncio.run(command(args))
        return found

    begun = ask(traces.begin, names=["main.n", "main.text"], before=2_000)
    assert begun["variables"][1] == {"name": "main.text", "type": "STRING[9]", "unit": ""}
    rig.until_ms(6_000)
    answer = ask(traces.read, number=begun["number"], since=0)
    most = VALUES_AT_ONCE // 4
    assert [row[3] for row in answer["rows"]] == list(range(1, most + 1))
    assert answer["next_row"] == 600
    answer = ask(traces.read, number=begun["number"], since=most)
    assert [row[:2] for row in answer["rows"]][-1] == [599, 600]
    for _ in range(MAX_TRACES - 1):
        ask(traces.begin, names=["main.n"], before=1)
    with pytest.raises(UsageError, match="too many traces"):
        ask(traces.begin, names=["main.n"], before=1)
    rig.until_ms(6_000 + KEPT_NS // 1_000_000 + 100)
    with pytest.raises(UsageError, match="there is no such trace"):
        ask(traces.read, number=begun["number"], since=0)
    assert rig.runner.on_scan is None
