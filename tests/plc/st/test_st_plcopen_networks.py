"""Bodies in Ladder Diagram and Function Block Diagram of PLCopen XML files (IEC 61131-3, 8.2 and 8.3)."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import pytest
from drawn_bodies import at, block, coil, contact, export, ladder, link, program, rail, result, scan, value, variables
from hypothesis import given, settings
from hypothesis import strategies as some

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.program import load_source


def test_contacts_in_series_and_in_parallel_and_a_negated_coil() -> None:
    made = ladder(
        variables("in", "a b c") + variables("out", "lamp dark"),
        contact(1, "a", 0), contact(2, "b", 1, x=2, how='negated="true"'), contact(3, "c", 0, y=5),
        coil(4, "lamp", 2, 3), coil(5, "dark", 4, x=10, how='negated="true"'),
    )  # fmt: skip
    for number, (a, b, c) in enumerate(product((False, True), repeat=3), 1):
        scan(made, number, a=a, b=b, c=c)
        assert (made.lamp, made.dark) == ((a and not b) or c, not ((a and not b) or c))


def test_set_and_reset_coils_keep_their_value() -> None:
    made = ladder(
        variables("in", "on off") + variables("out", "pump"),
        contact(1, "on", 0), coil(2, "pump", 1, how='storage="set"'),
        contact(3, "off", 0, y=10), coil(4, "pump", 3, y=10, how='storage="reset"'),
    )  # fmt: skip
    seen = []
    for number, (on, off) in enumerate(
        [(False, False), (True, False), (False, False), (True, True), (False, False)], 1
    ):
        scan(made, number, on=on, off=off)
        seen.append(made.pump)
    assert seen == [False, True, True, False, False]


def test_contacts_and_coils_for_edges_are_true_for_one_scan() -> None:
    made = ladder(
        variables("in", "a") + variables("out", "up down once"),
        contact(1, "a", 0, how='edge="rising"'), coil(2, "up", 1),
        contact(3, "a", 0, y=5, how='edge="falling"'), coil(4, "down", 3, y=5),
        contact(5, "a", 0, y=9), coil(6, "once", 5, y=9, how='edge="rising"'),
    )  # fmt: skip
    scan(made, 1, a=True)
    seen = []
    for number, a in enumerate([False, True, True, False, False], 2):
        scan(made, number, a=a)
        seen.append((made.up, made.down, made.once))
    assert seen == [(False, True, False), (True, False, True), (False,) * 3, (False, True, False), (False,) * 3]
    assert list(made.internal_names()) == []  # the blocks for the edges are not in the export


def test_networks_run_from_top_to_bottom_and_order_numbers_change_that() -> None:
    interface = variables("in", "a") + variables("out", "x y")
    upper = contact(1, "a", 0, y=1), coil(2, "x", 1, y=1)
    lower = contact(3, "x", 0, y=9), coil(4, "y", 3, y=9)
    made = ladder(interface, *lower, *upper)
    scan(made, 1, a=True)
    assert (made.x, made.y) == (True, True)
    made = ladder(interface, *upper[:1], coil(2, "x", 1, y=1, order=2), *lower[:1], coil(4, "y", 3, y=9, order=1))
    scan(made, 1, a=True)
    assert (made.x, made.y) == (True, False)
    scan(made, 2)
    assert made.y is True


def test_blocks_with_instances_and_functions_are_connected_by_their_outputs() -> None:
    made = program(export(
        "FBD", variables("in", "go n:INT") + variables("var", "t:TON") + variables("out", "lamp sum:INT big"),
        value(1, "go"), value(2, "T#15ms"), value(3, "n"), value(4, "2 * n"), value(5, "10"),
        block(6, "TON", {"IN": 1, "PT": 2}, "Q ET", instance="t"), result(7, "lamp", "6.Q"),
        block(8, "ADD", {"IN1": 3, "IN2": 4}, "OUT", y=20), result(9, "sum", "8.OUT", y=20),
        block(10, "GT", {"IN1": "8.OUT", "IN2": 5}, "OUT", x=8, y=20), result(11, "big", 10, x=12, y=30),
    ))  # fmt: skip
    seen = []
    for number in range(1, 5):
        scan(made, number, go=True, n=number)
        seen.append((made.lamp, made.sum, made.big))
    assert seen == [(False, 3, False), (False, 6, False), (True, 9, False), (True, 12, True)]


def test_a_loop_reads_the_last_value_of_a_function_block() -> None:
    made = program(export(
        "FBD", variables("in", "go") + variables("var", "t:TON") + variables("out", "pulse"),
        value(1, "go"), value(2, "T#20ms"),
        block(3, "AND", {"IN1": 1, "IN2": 4}, "OUT", x=3), block(4, "NOT", {"IN": "5.Q"}, "OUT", x=1),
        block(5, "TON", {"IN": "3.OUT", "PT": 2}, "Q ET", instance="t"), result(6, "pulse", "5.Q"),
    ))  # fmt: skip
    seen = []
    for number in range(1, 9):
        scan(made, number, go=True)
        seen.append(made.pulse)
    assert seen == [False, False, True, False, False, False, True, False]


def test_a_function_with_en_keeps_its_variable_while_en_is_false() -> None:
    made = ladder(
        variables("in", "a n:INT") + variables("out", "kept:INT done") + variables("var", "small:USINT"),
        contact(1, "a", 0), value(2, "n"), value(7, "5"),
        block(3, "MOVE", {"EN": 1, "IN": 2}, "ENO OUT"), result(4, "kept", "3.OUT", y=2), coil(5, "done", "3.ENO"),
        block(6, "MOVE", {"EN": "3.ENO", "IN": 7}, "ENO OUT", x=7), result(8, "small", "6.OUT", y=4),
    )  # fmt: skip
    seen = []
    for number, (a, n) in enumerate([(False, 3), (True, 4), (False, 5)], 1):
        scan(made, number, a=a, n=n)
        seen.append((made.kept, made.done, made.small))
    assert seen == [(0, False, 0), (4, True, 5), (4, False, 5)]


def test_a_return_ends_the_body_and_connectors_join_parts() -> None:
    made = ladder(
        variables("in", "a stop") + variables("out", "x y"),
        contact(1, "a", 0), f'<connector name="wire" {at(2, 3, 0)}{link(1)}</connector>',
        f'<continuation name="wire" {at(3, 4, 0)}<connectionPointOut/></continuation>', coil(4, "x", 3),
        contact(5, "stop", 0, y=5), f"<return {at(6, 9, 5)}{link(5)}</return>",
        contact(7, "a", 0, y=9), coil(8, "y", 7, y=9),
    )  # fmt: skip
    scan(made, 1, a=True, stop=True)
    assert (made.x, made.y) == (True, False)
    scan(made, 2, stop=False)
    assert made.y is True


def test_actions_may_be_drawn() -> None:
    text = export("ST", variables("in", "a") + variables("out", "n x"), "<p>Act(); n := x;</p>")
    body = rail(0) + contact(1, "a", 0, how='edge="rising"') + coil(2, "x", 1)
    action = f'<actions><action name="Act"><body><LD>{body}</LD></body></action></actions>\n<body>'
    made = program(text.replace("\n<body>", action))
    scan(made, 1, a=True)
    assert made.n is True
    scan(made, 2)
    assert made.n is False


@pytest.mark.parametrize(
    ("elements", "told"),
    [
        ((contact(1, "nothing", 0), coil(2, "x", 1)), "localId 1 of Main: a variable 'nothing' is not declared"),
        ((contact(1, "n", 0), coil(2, "x", 1)), "localId 1 of Main: the state of a contact; expected BOOL; got INT"),
        ((contact(1, "a"), coil(2, "x", 1)), "localId 1 of Main: the contact has no connection at its input"),
        ((contact(1, "a", 7), coil(2, "x", 1)), "localId 1 of Main: a connection to the element 7, which does not exist"),
        ((contact(1, "a", 0), coil(1, "x", 1)), "localId 1 of Main: the localId is used twice"),
        ((contact(1, "a", 0), coil(2, "1 + 2", 1)), "localId 2 of Main: 1 + 2 is not a variable"),
        ((contact(1, "a +", 0), coil(2, "x", 1)), "localId 1 of Main: a +: not Structured Text"),
        ((contact(1, "a", 2), contact(2, "a", 1), coil(3, "x", 2)), "which is executed later; put a variable between"),
        ((block(1, "Foo", {"A": 0}, "OUT"), coil(3, "x", 1)), "localId 1 of Main: a function 'Foo' is not declared"),
    ],
)  # fmt: skip
def test_an_error_names_the_element(elements: tuple[str, ...], told: str) -> None:
    with pytest.raises(FileInvalid) as e:
        ladder(variables("in", "a n:INT") + variables("out", "x"), *elements)
    assert told in str(e.value)
    assert e.value.line >= 3
    assert e.value.others == ()  # the elements that read its result add no error


@settings(max_examples=60, deadline=None)
@given(some.data())
def test_a_ladder_gives_the_value_of_its_formula(data: some.DataObject) -> None:
    """Build a random network of contacts; each contact reads contacts to its left. The reference evaluates it by hand."""
    count = data.draw(some.integers(1, 8))
    names = data.draw(some.lists(some.sampled_from("abcd"), min_size=count, max_size=count))
    inverted = data.draw(some.lists(some.booleans(), min_size=count, max_size=count))
    sources = [data.draw(some.lists(some.integers(0, n), min_size=1, max_size=3, unique=True)) for n in range(count)]
    parts = [
        contact(
            n + 1, names[n], *sources[n], x=n, y=data.draw(some.integers(0, 50)), how='negated="true"' * inverted[n]
        )
        for n in range(count)
    ]
    made = ladder(
        variables("in", "a b c d") + variables("out", "x"), *data.draw(some.permutations(parts)), coil(99, "x", count)
    )
    for number, values in enumerate(product((False, True), repeat=4), 1):
        given_values = dict(zip("abcd", values, strict=True))
        states = [True]
        for n in range(count):
            states.append(any(states[s] for s in sources[n]) and given_values[names[n]] != inverted[n])
        scan(made, number, **given_values)
        assert made.x == states[count]


def test_the_text_of_the_export_may_be_a_file(tmp_path: Path) -> None:
    path = tmp_path / "plant.xml"
    path.write_text(
        export("LD", variables("in", "a") + variables("out", "x"), rail(0), contact(1, "a", 0), coil(2, "x", 1))
    )
    made: Any = load_source(path)()
    scan(made, 1, a=True)
    assert made.x is True
    assert made.last_assignment("x")[0].line == 5
