"""The state machine of a program in Structured Text, as `fieldtwin plc diagram` draws it."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.cli.plc.diagram_command import diagram
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.plc.st.dialects import dialect_of
from fieldtwin.plc.st.state_diagram import OTHER, StateDiagram, state_diagrams
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.parse import parse_all, parse_expression
from fieldtwin.plc.st.syntax.written import text_of

TANK = """
TYPE Mode : (Idle, Filling, Fault, Lost) := Filling; END_TYPE
PROGRAM Main
VAR_INPUT start : BOOL; level : REAL; END_VAR
VAR state : Mode := Idle; after : TON; n : INT; END_VAR
after(IN := state = Filling, PT := T#5s);
CASE state OF
  Idle: IF start AND NOT (level > 2.0) THEN state := Mode#Filling; END_IF
  Mode#Filling:
    IF level >= 2.0 THEN state := Idle;
    ELSIF after.Q THEN state := Fault; END_IF
ELSE
  CASE n OF
    3: state := Idle;
  END_CASE
END_CASE
END_PROGRAM
"""


def machines(text: str, dialect: str = "standard") -> list[StateDiagram]:
    return list(state_diagrams(parse_all(text, "main.st", dialect_of(dialect))))


def arrows(machine: StateDiagram) -> list[tuple[str, str, str]]:
    return [(each.source, each.target, each.label) for each in machine.transitions]


def program(body: str, variables: str = "state : INT;") -> str:
    return f"PROGRAM Main VAR {variables} END_VAR\n{body}\nEND_PROGRAM"


def test_the_branches_of_a_case_over_an_enumeration_are_the_states():
    (machine,) = machines(TANK)
    assert (machine.pou, machine.variable, machine.initial) == ("Main", "state", "Idle")
    assert machine.states == ("Idle", "Filling", "Fault", "Lost")
    assert arrows(machine) == [
        ("Idle", "Filling", "start AND NOT (level > 2.0)"),
        ("Filling", "Idle", "level >= 2.0"),
        ("Filling", "Fault", "after.Q"),
        ("Fault", "Idle", "n = 3"),
        ("Lost", "Idle", "n = 3"),
    ]


def test_a_case_over_a_number_has_its_labels_as_states():
    (machine,) = machines(program("CASE state OF 0: state := 10; 10, 20: state := 0; ELSE state := 20; END_CASE"))
    assert machine.states == ("0", "10", "20", OTHER)
    assert machine.initial == "0"
    assert arrows(machine) == [("0", "10", ""), ("10", "0", ""), ("20", "0", ""), (OTHER, "20", "")]


def test_an_assignment_outside_of_the_case_leaves_every_other_state():
    (machine,) = machines(program("CASE state OF 0: state := 1; 1: ; 2: ; END_CASE\nIF FALSE THEN state := 2; END_IF"))
    assert arrows(machine) == [("0", "1", ""), ("0", "2", "FALSE"), ("1", "2", "FALSE")]


def test_a_body_of_an_action_counts_where_it_is_called():
    text = program(
        "CASE state OF 0: IF TRUE THEN Fill(); END_IF 1: ; END_CASE\nACTION Fill: state := 1; Fill(); END_ACTION"
    )
    (machine,) = machines(text)
    assert arrows(machine) == [("0", "1", "TRUE")]


def test_a_computed_next_state_is_named_and_not_drawn():
    (machine,) = machines(program("CASE state OF 0: state := 1; 1: state := state + 1; END_CASE"))
    assert arrows(machine) == [("0", "1", "")]
    assert [(pos.path, pos.line) for pos in machine.computed] == [("main.st", 2)]


def test_a_case_whose_branches_do_not_assign_its_variable_is_no_state_machine():
    assert machines(program("CASE state OF 0: n := 1; 1: ; END_CASE", "state : INT; n : INT;")) == []


def test_a_sequential_function_chart_has_its_steps_as_states():
    text = """PROGRAM Main VAR go : BOOL; END_VAR
    STEP b: END_STEP
    INITIAL_STEP a: END_STEP
    STEP c: END_STEP
    TRANSITION FROM a TO (b, c) := go AND b.T = T#0s; END_TRANSITION
    TRANSITION FROM (b, c) TO A := TRUE; END_TRANSITION
    END_PROGRAM"""
    (machine,) = machines(text)
    assert (machine.states, machine.initial) == (("b", "a", "c"), "a")
    assert arrows(machine) == [
        ("a", "b", "go AND b.T = T#0s"),
        ("a", "c", "go AND b.T = T#0s"),
        ("b", "a", "TRUE"),
        ("c", "a", "TRUE"),
    ]


def test_states_are_found_by_their_qualified_names_of_codesys():
    text = TANK.replace("Mode#Filling", "Mode.Filling")
    assert arrows(machines(text, "codesys")[0]) == arrows(machines(TANK)[0])


def without_places(expr: object) -> object:
    """Return an expression as nested tuples, without the places of its parts."""
    if isinstance(expr, tuple):
        return tuple(map(without_places, expr))
    if hasattr(expr, "__dataclass_fields__"):
        fields = [name for name in expr.__dataclass_fields__ if name != "pos"]
        return (type(expr).__name__, *(without_places(getattr(expr, name)) for name in fields))
    return expr


NAMES = st.sampled_from(["a", "b.Q", "c[1, a]", "w.3", "T#5s", "2.0", "16#FF", "Mode#Run", "f(x := a, y => b)", "g()"])
OPERATORS = ["OR", "XOR", "AND", "&", "=", "<>", "<", ">=", "+", "-", "*", "/", "MOD", "**", "OR_ELSE", "AND_THEN"]
EXPRESSIONS = st.recursive(
    NAMES,
    lambda inner: st.one_of(
        st.tuples(
            inner,
            st.sampled_from(OPERATORS),
            inner,
        ).map(lambda parts: f"({parts[0]}) {parts[1]} ({parts[2]})"),
        st.tuples(st.sampled_from(["NOT ", "-"]), inner).map(lambda parts: f"{parts[0]}({parts[1]})"),
    ),
    max_leaves=12,
)


@given(EXPRESSIONS)
def test_the_text_of_an_expression_has_the_same_meaning(text: str) -> None:
    at = t.Pos(1, 1)
    parsed = parse_expression(text, at)
    assert without_places(parse_expression(text_of(parsed), at)) == without_places(parsed)


def drawn(*words: str) -> Result:
    return CliRunner().invoke(diagram, words, standalone_mode=False, catch_exceptions=False)


def test_a_file_is_drawn_without_a_system(tmp_path: Path) -> None:
    file = tmp_path / "tank.st"
    file.write_text(TANK)
    done = drawn(str(file))
    assert done.return_value == 0
    assert "<title>tank.st: Main</title>" in done.stdout
    assert "after.Q" in done.stdout


def test_a_computed_state_is_reported_with_its_place(tmp_path: Path) -> None:
    file = tmp_path / "tank.st"
    file.write_text(program("CASE state OF 0: state := 1;\n1: state := state + 1; END_CASE"))
    assert f"{file}:3:4: not drawn: the next state is computed" in drawn(str(file)).stderr


@pytest.mark.parametrize(
    ("text", "options", "said"),
    [
        (TANK, ["--program", "Pump"], "Main"),
        (TANK.replace("level : REAL", "level : INTEGER"), [], "INTEGER"),
        ("PROGRAM Main\nEND_PROGRAM", [], "no program has a chart, a body in LD or FBD, or a state machine"),
        (TANK + TANK.replace("Main", "Second").partition("END_TYPE")[2], [], "--program NAME"),
    ],
)
def test_what_cannot_be_drawn_is_named(tmp_path: Path, text: str, options: list[str], said: str) -> None:
    file = tmp_path / "tank.st"
    file.write_text(text)
    with pytest.raises(FieldtwinError, match=said):
        drawn(str(file), *options)
