"""Labels, jumps and returns in Ladder Diagram and Function Block Diagram (IEC 61131-3, execution control elements)."""

from __future__ import annotations

import re
from typing import Any

import pytest
from drawn_bodies import (
    block,
    coil,
    contact,
    export,
    jump,
    label,
    ladder,
    leave,
    program,
    rail,
    result,
    scan,
    value,
    variables,
)
from drawn_boxes import SVG, Read
from hypothesis import given, settings
from hypothesis import strategies as some

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.program import ScanTooLong
from fieldtwin.plc.st.coverage.probes import Probes
from fieldtwin.plc.st.decisions.statements import decisions_of
from fieldtwin.plc.st.drawing.drawings import Drawing, drawings_of
from fieldtwin.plc.st.findings.find import findings
from fieldtwin.plc.st.plcopen.read import read_plcopen

FORWARD = (
    contact(1, "skip", 0, y=0), jump(2, "after", 1, y=0),
    contact(3, "a", 0, y=10), coil(4, "x", 3, y=10),
    label(5, "After", y=20),
    contact(6, "a", 0, y=22), coil(7, "y", 6, y=22),
)  # fmt: skip
IN_OUT = variables("in", "a skip") + variables("out", "x y")

COUNT = (
    value(1, "0"), result(2, "sum", 1, y=0), value(3, "n"), result(4, "left", 3, y=10),
    label(5, "again", y=20),
    value(6, "sum"), value(7, "left"), block(8, "ADD", {"IN1": 6, "IN2": 7}, "OUT", y=22), result(9, "sum", 8, y=22),
    value(10, "left"), value(11, "1"), block(12, "SUB", {"IN1": 10, "IN2": 11}, "OUT", y=30), result(13, "left", 12, y=30),
    value(14, "left"), value(15, "0"), block(16, "GT", {"IN1": 14, "IN2": 15}, "OUT", y=40), jump(17, "again", 16, y=40),
    value(18, "sum"), value(19, "2"), block(20, "MUL", {"IN1": 18, "IN2": 19}, "OUT", y=50), result(21, "twice", 20, y=50),
)  # fmt: skip
NUMBERS = variables("in", "n:INT") + variables("out", "sum:INT twice:INT") + variables("var", "left:INT")


def test_a_jump_forward_leaves_out_the_networks_before_its_label() -> None:
    made = ladder(IN_OUT, *FORWARD)
    scan(made, 1, a=True, skip=True)
    assert (made.x, made.y) == (False, True)
    scan(made, 2, skip=False)
    assert (made.x, made.y) == (True, True)
    scan(made, 3, a=False, skip=True)
    assert (made.x, made.y) == (True, False)  # the coil keeps its value


def test_a_jump_back_repeats_the_networks_from_its_label_on() -> None:
    made = program(export("FBD", NUMBERS, *COUNT))
    for number, (n, expected) in enumerate([(1, 1), (4, 10), (100, 5050)], 1):
        scan(made, number, n=n)
        assert (made.sum, made.twice) == (expected, 2 * expected)


def test_a_jump_back_counts_as_an_iteration_of_a_loop() -> None:
    made = ladder(
        variables("in", "a") + variables("out", "x"), label(1, "here"), contact(2, "a", 0), jump(3, "here", 2)
    )
    scan(made, 1, a=False)
    with pytest.raises(ScanTooLong, match="more than 1,000,000 loop iterations") as e:
        scan(made, 2, a=True)
    assert [str(one.path) + f":{one.lineno + 1}" for one in e.traceback if str(one.path).endswith(".xml")] == [
        "plant.xml:6"
    ]


def test_an_unconditional_jump_and_return_have_no_input() -> None:
    networks = (
        jump(1, "second", y=0), label(2, "first", y=10), contact(3, "a", 0, y=10), coil(4, "x", 3, y=10), leave(5, y=20),
        label(6, "second", y=30), contact(7, "a", 0, y=30), coil(8, "y", 7, y=30), jump(9, "FIRST", y=40),
    )  # fmt: skip
    made = ladder(IN_OUT, *networks)
    scan(made, 1, a=True)
    assert (made.x, made.y) == (True, True)


def test_a_label_without_positions_stands_before_its_network_in_the_file() -> None:
    flat = [
        contact(1, "skip", 0, x=0), jump(2, "after", 1, x=0), contact(3, "a", 0, x=0), coil(4, "x", 3, x=0),
        label(5, "after"), contact(6, "a", 0, x=0), coil(7, "y", 6, x=0),
    ]  # fmt: skip
    made = ladder(IN_OUT, *flat)
    scan(made, 1, a=True, skip=True)
    assert (made.x, made.y) == (False, True)


@pytest.mark.parametrize("y", [15, 20, 24, 29])
def test_a_label_may_stand_above_or_beside_its_network(y: int) -> None:
    upper, lower = (contact(3, "a", 0, y=10), coil(4, "x", 3, y=10)), (contact(6, "a", 0, y=20), coil(7, "y", 6, y=30))
    made = ladder(IN_OUT, contact(1, "skip", 0), jump(2, "after", 1), label(5, "after", y=y), *upper, *lower)
    scan(made, 1, a=True, skip=True)
    assert (made.x, made.y) == (False, True)


def test_a_label_with_an_order_number_stands_before_the_networks_with_greater_numbers() -> None:
    networks = (
        contact(1, "skip", 0, y=50), jump(2, "after", 1, y=50, order=1), contact(3, "a", 0, y=40), coil(4, "x", 3, y=40, order=2),
        label(5, "after", y=90, order=3), contact(6, "a", 0, y=10), coil(7, "y", 6, y=10, order=4),
    )  # fmt: skip
    made = ladder(IN_OUT, *networks)
    scan(made, 1, a=True, skip=True)
    assert (made.x, made.y) == (False, True)


def test_a_label_at_the_end_and_a_label_without_a_jump() -> None:
    made = ladder(
        IN_OUT,
        contact(1, "skip", 0),
        jump(2, "end", 1),
        contact(3, "a", 0, y=5),
        coil(4, "x", 3, y=5),
        label(5, "end", y=9),
    )
    scan(made, 1, a=True, skip=True)
    assert made.x is False
    made = ladder(IN_OUT, label(1, "unused"), contact(3, "a", 0, y=5), coil(4, "x", 3, y=5))
    scan(made, 1, a=True)
    assert made.x is True


def test_jumps_in_functions_and_function_blocks_and_timers_between_them() -> None:
    body = "".join(COUNT)
    pou = (
        f'<pou name="Sum" pouType="functionBlock"><interface>{NUMBERS}</interface><body><FBD>{body}</FBD></body></pou>'
    )
    made = program(export(
        "FBD", variables("in", "n:INT") + variables("var", "s:Sum") + variables("out", "y:INT"),
        value(1, "n"), block(2, "Sum", {"n": 1}, "sum twice", instance="s"), result(3, "y", "2.sum"), more=pou,
    ))  # fmt: skip
    scan(made, 1, n=3)
    assert made.y == 6


@pytest.mark.parametrize(
    ("elements", "told"),
    [
        ((jump(1, "nowhere", 0),), "localId 1 of Main: a jump to the label 'nowhere', which the body does not have"),
        ((label(1, "on"), label(2, "ON", y=5)), "localId 2 of Main: the label ON is declared twice"),
        ((label(1, " "),), "localId 1 of Main: the label has no name"),
        (('<jump label="on" localId="1"><connectionPointIn/></jump>', label(2, "on")), "the jump has no connection at its input"),
        (
            (contact(1, "a", 0), coil(2, "x", 1, order=1), label(3, "on", order=2),
             coil(4, "y", 1, order=3), jump(5, "on", 0, order=4)),
            "localId 4 of Main: a label separates it from the contact with localId 1, whose result it reads; put a variable",
        ),
    ],
)  # fmt: skip
def test_an_error_names_the_element(elements: tuple[str, ...], told: str) -> None:
    with pytest.raises(FileInvalid) as e:
        ladder(IN_OUT, *elements)
    assert told in str(e.value)
    assert e.value.line >= 3


def test_the_last_assignment_and_the_places_of_coverage_name_the_elements() -> None:
    text = export("LD", IN_OUT, rail(0), *FORWARD)
    made = ladder(IN_OUT, *FORWARD)
    scan(made, 1, a=True, skip=True)
    assert made.last_assignment("y")[0].line == text[: text.index('localId="7"')].count("\n") + 1
    probes = Probes()
    probes.insert(read_plcopen(text, "plant.xml"), ())
    places = probes.result(set(), {})
    lines = {place.line for place in places}
    assert {text[: text.index(f'localId="{n}"')].count("\n") + 1 for n in (2, 4, 7)} <= lines


def test_the_cause_of_a_value_behind_a_label_names_the_condition_of_its_network() -> None:
    """A coil that sets its variable depends on its contact, also in a body with jumps."""
    stored = (*FORWARD[:5], contact(6, "a", 0, y=22), coil(7, "y", 6, y=22, how='storage="set"'))
    text = export("LD", IN_OUT, rail(0), *stored)
    line = text[: text.index('localId="7"')].count("\n") + 1
    decision = decisions_of(read_plcopen(text, "plant.xml")).at("plant.xml", line, ["y"])
    assert decision is not None
    assert [one.line for one in decision.conditions] == [line]


def test_networks_after_an_unconditional_jump_are_a_finding() -> None:
    elements = jump(1, "end"), contact(2, "a", 0, y=10), coil(3, "x", 2, y=10), label(4, "end", y=20)
    text = export("LD", IN_OUT, rail(0), *elements)
    found = [one for one in findings(read_plcopen(text, "plant.xml")) if one.id == "ST107"]
    assert [(one.message, one.line) for one in found] == [("a statement after JMP is never executed", 5)]


def test_a_live_drawing_has_the_values_of_all_networks() -> None:
    made = ladder(IN_OUT, *FORWARD)
    scan(made, 1, a=True, skip=True)
    nodes = made.drawn(0)["nodes"]
    assert (nodes["1"], nodes["3"], nodes["6"], nodes["7"]) == (True, True, True, True)


def drawing(text: str) -> Drawing:
    (one,) = drawings_of(read_plcopen(text, "plant.xml"))
    return one


@pytest.mark.parametrize("placed", [True, False], ids=["positions", "no positions"])
def test_labels_jumps_and_returns_are_drawn(placed: bool) -> None:
    text = export("LD", IN_OUT, rail(0), *FORWARD, contact(8, "a", 0, y=30), leave(9, 8, y=30))
    if placed:
        text = re.sub(r'x="(\d+)" y="(\d+)"', lambda at: f'x="{40 * int(at[1])}" y="{8 * int(at[2])}"', text)
    else:
        text = re.sub("<position [^>]*/>", "", text)
    one = drawing(text)
    read = Read(one.svg("Main"))
    assert read.problems() == []
    texts = {
        e.attrib["data-node"]: [t.text for t in e.iter(f"{SVG}text")]
        for e in read.root.iter()
        if "data-node" in e.attrib
    }
    assert (texts["2"], texts["5"], texts["9"]) == (["after"], ["After:"], ["<RETURN>"])
    assert one.networks == 4  # the label belongs to the network below it
    assert {e.attrib["data-node"] for e in Read(one.svg("Main", 3)).root.iter() if "data-node" in e.attrib} == {
        "0",
        "5",
        "6",
        "7",
    }


@settings(max_examples=100, deadline=None)
@given(some.data())
def test_jumps_forward_execute_the_networks_that_the_labels_select(data: some.DataObject) -> None:
    """Each network negates its output; before each there may be a jump to a later label, which one input enables."""
    count = data.draw(some.integers(1, 6))
    targets = [data.draw(some.one_of(some.none(), some.integers(n + 1, count))) for n in range(count)]
    conditions = data.draw(some.lists(some.booleans(), min_size=count, max_size=count))
    elements, outs = [], [f"x{n}" for n in range(count)]
    for n, target in enumerate(targets):
        y = 100 * n
        elements.append(label(10 * n + 11, f"L{n}", y=y))
        if target is not None:
            elements += [
                contact(10 * n + 12, f"c{n}", 0, y=y + 10),
                jump(10 * n + 13, f"L{target}", 10 * n + 12, y=y + 10),
            ]
        elements += [
            contact(10 * n + 14, f"x{n}", 0, y=y + 50, how='negated="true"'),
            coil(10 * n + 15, f"x{n}", 10 * n + 14, y=y + 50),
        ]
    elements.append(label(10 * count + 11, f"L{count}", y=100 * count))
    names = " ".join(f"c{n}" for n in range(count))
    made: Any = ladder(
        variables("in", names) + variables("out", " ".join(outs)), *data.draw(some.permutations(elements))
    )
    scan(made, 1, **{f"c{n}": one for n, one in enumerate(conditions)})
    expected, n = [False] * count, 0
    while n < count:
        target = targets[n]
        if target is not None and conditions[n]:
            n = target
        else:
            expected[n] = True
            n += 1
    assert [getattr(made, one) for one in outs] == expected
