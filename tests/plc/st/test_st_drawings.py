"""Drawings of sequential function charts as SVG: every part is drawn once, and nothing hides anything else."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from pathlib import Path

import pytest
from click.testing import CliRunner
from drawn_boxes import Read
from hypothesis import given
from hypothesis import strategies as st
from random_charts import random_charts, text_of_chart

from fieldtwin.cli.plc.diagram_command import diagram
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.st.drawing.chart import draw_chart
from fieldtwin.plc.st.drawing.drawings import drawings_of
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.parse import parse_all

TANK = """
PROGRAM Main
VAR_INPUT start, stop, fault : BOOL; level : REAL; END_VAR
VAR_OUTPUT valve, horn, full : BOOL; END_VAR
  INITIAL_STEP Idle: END_STEP
  STEP Filling: valve(N, full); Count(P1); horn(L, T#2s500ms); END_STEP
  STEP Heating: END_STEP
  STEP Mixing: END_STEP
  STEP Draining_of_the_intermediate_vessel_into_the_second_vessel: END_STEP
  STEP Alarm: horn(S); END_STEP
  TRANSITION FROM Idle TO Filling := start AND NOT stop; END_TRANSITION
  TRANSITION ready (PRIORITY := 2) FROM Filling TO (Heating, Mixing) :=
    level >= 2.0 AND NOT fault AND (start OR level > 1.5) AND NOT stop AND level < 100.0 AND level <> 50.0;
  END_TRANSITION
  TRANSITION (PRIORITY := 1) FROM Filling TO Alarm := fault; END_TRANSITION
  TRANSITION done FROM (Heating, Mixing) TO Draining_of_the_intermediate_vessel_into_the_second_vessel:
    done := level < 1.0; END_TRANSITION
  TRANSITION FROM Draining_of_the_intermediate_vessel_into_the_second_vessel TO Idle := level < 0.1; END_TRANSITION
  TRANSITION FROM Alarm TO Idle := NOT fault; END_TRANSITION
  ACTION Count: full := TRUE; END_ACTION
END_PROGRAM
"""


def chart(text: str) -> t.Chart:
    (pou,) = parse_all(text).pous
    assert pou.chart is not None
    return pou.chart


def read(text: str) -> Read:
    return Read(draw_chart(chart(text), "test"))


def test_a_chart_has_steps_transitions_and_action_blocks_in_the_notation_of_the_standard() -> None:
    drawn = read(TANK)
    assert drawn.problems() == []
    assert Counter(drawn.groups("transition", "transition")) == Counter(map(str, range(6)))
    assert drawn.groups("action", "of") == ["valve", "Count", "horn", "horn"]
    texts = [one.what for one in drawn.texts]
    for wanted in (
        "start AND NOT stop",
        "N",
        "full",
        "L T#2s500ms",
        "1",
        "done",
        "Draining_of_the_intermediate_vessel_int…",
    ):
        assert wanted in texts
    assert texts.count("Idle") == 3  # the step, and the arrows of both loops
    assert sum(box.what == "bar" for box in drawn.boxes) == 6
    assert [e.attrib["class"] for e in drawn.root.iter() if e.attrib.get("class") == "inner"] == ["inner"]
    paths = [e.attrib["d"] for e in drawn.root.iter() if e.attrib.get("class") == "line"]
    across = sorted(float(path.split(",")[1].split()[0]) for path in paths if path.count("L") == 1 and is_level(path))
    pairs = [b - a for a, b in pairwise(across)]
    assert pairs.count(5.0) == 2  # the double lines before and after the simultaneous branches


def is_level(path: str) -> bool:
    (_, first), (_, last) = (point.split(",") for point in path.removeprefix("M").split(" L"))
    return first == last


@given(random_charts())
def test_a_random_safe_chart_is_drawn_completely_and_without_overlaps(
    built: tuple[list[str], list[tuple[list[str], list[str]]]],
) -> None:
    steps, moves = built
    drawn = read(text_of_chart(steps, moves).replace(":= c", ":= a_rather_long_name_of_a_signal AND c"))
    assert drawn.problems() == []
    jumps = {e[-1].text for e in drawn.root.iter() if e.attrib.get("class") == "jump"}
    several = [tuple(names) for move in moves for names in move if len(names) > 1]
    if len(several) == len(
        set(several)
    ):  # no alternatives into or out of one simultaneous branch, which no line can show
        assert jumps <= {"s0"}  # only the loop to the initial step is an arrow; other branches end in lines
    assert Counter(drawn.groups("step", "step")) == Counter(steps)
    assert Counter(drawn.groups("transition", "transition")) == Counter(map(str, range(len(moves))))


STEPS = ["s0", "s1", "s2", "s3", "s4"]
some_steps = st.lists(st.sampled_from(STEPS), min_size=1, max_size=3, unique=True)


@given(st.lists(st.tuples(some_steps, some_steps), min_size=1, max_size=9))
def test_any_other_chart_is_also_drawn_completely(moves: list[tuple[list[str], list[str]]]) -> None:
    drawn = read(text_of_chart(STEPS, moves))
    assert drawn.problems() == []
    assert Counter(drawn.groups("step", "step")) == Counter(STEPS)
    assert Counter(drawn.groups("transition", "transition")) == Counter(map(str, range(len(moves))))


def test_a_long_sequence_that_each_step_can_abort_is_one_straight_line() -> None:
    steps = [f"s{n}" for n in range(400)]
    moves = [([a], [b]) for a, b in pairwise(steps)] + [([step], ["s0"]) for step in steps[1:]]
    drawn = read(text_of_chart(steps, moves))
    assert drawn.view.right - drawn.view.left < 500
    assert Counter(drawn.groups("step", "step")) == Counter(steps)


def test_a_chart_with_too_many_branches_inside_each_other_is_refused() -> None:
    steps = [f"s{n}" for n in range(1200)]
    moves = [([f"s{n // 2}"], [f"s{n}"]) for n in range(1, 3)]
    moves += [([f"s{n}"], [f"s{n + 2}"]) for n in range(1, 1198, 2)] + [
        ([f"s{n}"], [f"s{n + 3}"]) for n in range(1, 1197, 2)
    ]
    (one,) = drawings_of(parse_all(text_of_chart(steps, moves)))
    with pytest.raises(UsageError, match="too many branches inside each other"):
        one.svg("deep")


def test_the_chart_of_an_action_has_a_drawing_of_its_own(tmp_path: Path) -> None:
    file = tmp_path / "main.st"
    file.write_text(
        "PROGRAM Main\nINITIAL_STEP A: Blink(N); END_STEP\nACTION Blink: INITIAL_STEP Red: END_STEP END_ACTION\nEND_PROGRAM"
    )
    done = CliRunner().invoke(
        diagram, [str(file), "--program", "main.blink"], standalone_mode=False, catch_exceptions=False
    )
    assert done.return_value == 0
    assert Read(done.stdout).groups("step", "step") == ["Red"]
    assert "prefers-color-scheme: dark" in done.stdout
