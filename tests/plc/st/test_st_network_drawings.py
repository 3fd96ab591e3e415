"""Drawings of Ladder Diagrams and Function Block Diagrams of PLCopen XML files as SVG."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from drawn_boxes import SVG, Read
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.cli.plc.diagram_command import diagram
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.st.drawing.drawings import drawings_of
from fieldtwin.plc.st.plcopen.read import read_plcopen

PLANT = Path(__file__).parents[2] / "vectors" / "plcopen" / "drawn_networks.xml"
TEXT = PLANT.read_text()
FLAT = re.sub(r"<(position|relPosition) [^>]*/>| (width|height)=\"\d+\"", "", TEXT)
"""The same without positions and sizes, as some tools write it."""


def drawn(pou: str, text: str = TEXT, network: int = 0) -> Read:
    (one,) = (one for one in drawings_of(read_plcopen(text, "plant.xml")) if one.pou == pou)
    return Read(one.svg(pou, network))


@pytest.mark.parametrize("text", [TEXT, FLAT], ids=["positions", "no positions"])
@pytest.mark.parametrize("pou", ["Motor", "Tank"])
def test_every_element_is_drawn_and_nothing_hides_another(pou: str, text: str) -> None:
    read = drawn(pou, text)
    assert read.problems() == []
    ids = {e.attrib["data-node"] for e in read.root.iter() if "data-node" in e.attrib}
    body = text[text.index(f'name="{pou}"') :].partition("</pou>")[0]
    assert ids == set(re.findall(r'localId="(\d+)"', body))
    wires = [(e.attrib["data-from"], e.attrib["data-pin"]) for e in read.root.iter() if e.attrib.get("class") == "wire"]
    assert sorted(source for source, _ in wires) == sorted(re.findall(r'refLocalId="(\d+)"', body))


def test_contacts_coils_and_pins_have_the_signs_of_the_standard() -> None:
    read = drawn("Motor")

    def texts(kind: str, node: str) -> list[str | None]:
        (group,) = (e for e in read.root.iter() if e.attrib.get("class") == kind and e.attrib.get("data-node") == node)
        return [e.text for e in group.iter(f"{SVG}text")]

    assert texts("contact", "2") == ["start_button"]
    assert texts("contact", "4") == ["/", "stop_button"]
    assert texts("contact", "5") == ["P", "release"]
    assert texts("coil", "10") == ["S", "alarm"]
    assert texts("block", "7") == ["TON", "no_flow", "IN", "PT", "Q", "ET"]
    tank = drawn("Tank")
    (block,) = (e for e in tank.root.iter() if e.attrib.get("data-node") == "5")
    assert len(list(block.iter(f"{SVG}circle"))) == 1  # the negated input


def places(read: Read) -> dict[str, tuple[float, float]]:
    found = {}
    for group in read.root.iter(f"{SVG}g"):
        rect = group.find(f"{SVG}rect")
        if "data-node" in group.attrib and rect is not None:
            found[group.attrib["data-node"]] = (float(rect.attrib["x"]), float(rect.attrib["y"]))
    return found


def test_the_elements_are_where_the_engineer_put_them() -> None:
    body = TEXT[TEXT.index('name="Tank"') :].partition("</pou>")[0]
    given_places = {
        local: (float(x), float(y))
        for local, x, y in re.findall(r'localId="(\d+)"[^>]*><position x="(\d+)" y="(\d+)"', body)
    }
    shown = places(drawn("Tank"))
    assert shown.keys() == given_places.keys()
    for axis in (0, 1):
        factors = {
            round((shown[a][axis] - shown[b][axis]) / (given_places[a][axis] - given_places[b][axis]), 1)
            for a, b in pairwise(shown) if given_places[a][axis] != given_places[b][axis]
        }  # fmt: skip
        assert len(factors) == 1  # one factor for the whole drawing
        assert 1 <= factors.pop() <= 3


@pytest.mark.parametrize("text", [TEXT, FLAT], ids=["positions", "no positions"])
def test_long_names_have_room(text: str) -> None:
    for short, long in {
        "start_button": "start_button_of_pump_1",
        "stop_button": "stop_button_of_pump_1",
        "motor": "pump_1_runs",
    }.items():
        text = text.replace(f"{short}<", f"{long}<").replace(f'"{short}"', f'"{long}"')
    read = drawn("Motor", text)
    assert read.problems() == []
    assert {"start_button_of_pump_1", "stop_button_of_pump_1", "flow_is_present_in_the_pipe"} <= {
        t.what for t in read.texts
    }
    (rail,) = (e for e in read.root.iter() if e.attrib.get("class") == "leftPowerRail")
    x = float(rail[-1].attrib["d"].removeprefix("M").partition(",")[0])
    assert all(text.left > x or text.right < x for text in read.texts if "_" in text.what)


def test_one_network_is_drawn_alone_and_an_unknown_one_is_refused() -> None:
    read = drawn("Motor", network=2)
    ids = {e.attrib["data-node"] for e in read.root.iter() if "data-node" in e.attrib}
    assert ids == {"1", "7", "8", "9", "10", "11"}
    assert read.problems() == []
    with pytest.raises(UsageError, match="no network 3; expected 1 to 2"):
        drawn("Motor", network=3)


def vertical_lines(read: Read) -> list[tuple[str, float, float, float]]:
    """Return the output, the place and the ends of each vertical line of a connection."""
    found = []
    for group in (e for e in read.root.iter(f"{SVG}g") if e.attrib["class"] == "wire"):
        output = f"{group.attrib['data-from']}.{group.attrib['data-pin']}"
        points = [tuple(map(float, one.split(","))) for one in group[0].attrib["d"].removeprefix("M").split(" L")]
        for (x, y), (other_x, other_y) in pairwise(points):
            assert x == other_x or y == other_y, "a connection has a diagonal line"
            if x == other_x:
                found.append((output, x, min(y, other_y), max(y, other_y)))
    return found


def chain(links: list[list[int]]) -> str:
    """Return a body of function blocks; each reads variables and the outputs of the given earlier blocks."""
    body = ""
    for number, sources in enumerate(links, 1):
        ports = [f'<connection refLocalId="{source}" formalParameter="OUT"/>' for source in sources]
        ports.append(f'<connection refLocalId="{100 + number}"/>')
        inputs = "".join(
            f'<variable formalParameter="IN{n}"><connectionPointIn>{port}</connectionPointIn></variable>'
            for n, port in enumerate(ports, 1)
        )
        body += (
            f'<inVariable localId="{100 + number}"><connectionPointOut/><expression>signal_{number}</expression></inVariable>'
            f'<block localId="{number}" typeName="AND"><inputVariables>{inputs}</inputVariables><outputVariables>'
            '<variable formalParameter="OUT"><connectionPointOut/></variable></outputVariables></block>'
        )
    return (
        '<project xmlns="http://www.plcopen.org/xml/tc6_0201"><types><pous><pou name="Main" pouType="program"><interface/>'
        f"<body><FBD>{body}</FBD></body></pou></pous></types></project>"
    )


@given(st.lists(st.lists(st.integers(1, 9), max_size=3, unique=True), min_size=1, max_size=10))
def test_random_networks_without_positions_do_not_overlap(links: list[list[int]]) -> None:
    earlier = [[source for source in sources if source < number] for number, sources in enumerate(links, 1)]
    read = drawn("Main", chain(earlier))
    assert read.problems() == []
    assert len(read.groups("block", "node")) == len(links)
    lines = vertical_lines(read)
    for output, x, low, high in lines:
        for other, other_x, other_low, other_high in lines:
            if output != other and abs(x - other_x) < 1:
                assert high < other_low or other_high < low, "two outputs share a line"


def test_a_power_rail_without_a_length_reaches_its_contacts() -> None:
    body = "".join(
        f'<contact localId="{n}"><position x="{60 + n}" y="{y}"/><connectionPointIn><connection refLocalId="1"/>'
        "</connectionPointIn><connectionPointOut/><variable>a</variable></contact>"
        for n, y in ((2, 20), (3, 300))
    )
    rail = '<leftPowerRail localId="1"><position x="0" y="0"/><connectionPointOut/></leftPowerRail>'
    text = re.sub(r"<FBD>.*</FBD>", f"<LD>{rail}{body}</LD>", chain([[]]), flags=re.DOTALL)
    read = drawn("Main", text.replace("<interface/>", "<interface><localVars><variable name='a'><type><BOOL/></type></variable>"
                                      "</localVars></interface>"))  # fmt: skip
    assert vertical_lines(read) == []  # each connection is a straight line


def run(*words: str) -> Result:
    return CliRunner().invoke(diagram, words, standalone_mode=False, catch_exceptions=False)


def test_the_command_draws_a_network_of_a_file() -> None:
    done = run(str(PLANT), "--program", "motor", "--network", "1")
    assert "<title>drawn_networks.xml: Motor</title>" in done.stdout
    with pytest.raises(UsageError, match="several programs can be drawn"):
        run(str(PLANT))
