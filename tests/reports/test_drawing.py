"""Drawn wiring: the content of a system file is in the text and in the picture, and the shipped pictures are current."""

from __future__ import annotations

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
from click.testing import CliRunner

from fieldtwin.acoustic import map as water
from fieldtwin.acoustic.network import load_network
from fieldtwin.cli.main import cli
from fieldtwin.reports.drawing.svg import ROOM, svg
from fieldtwin.reports.drawing.tree import tree
from fieldtwin.reports.drawing.wiring import Wiring, wiring
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.groups import group_file
from fieldtwin.twin.site.system import load_system

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = sorted(
    path.name.removesuffix(".prototype.yaml") for path in (ROOT / "profiles/systems").glob("*.prototype.yaml")
)


def of(name: str | Path, *, prototype: bool = True) -> Wiring:
    system = load_system(str(name))
    return wiring(system, load_prototype(system) if prototype else None)


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eleven sensors on a line, one on the plant's own network, and a bridge."""
    folder = tmp_path_factory.mktemp("many")
    sensors = "".join(f"  m{n}: {{profile: range-sensor, bus: a, unit: {n}}}\n" for n in range(1, 12))
    (folder / "many.yaml").write_text(
        "fieldtwin: 1\nsystem: many\n"
        "buses:\n  a: {url: 'rtu:/dev/ttyS0?baudrate=19200&frame=8E1'}\n  b: {url: 'tcp://plc:502'}\n"
        f"devices:\n{sensors}  x: {{profile: range-sensor, bus: b, unit: 1, poll: {{values: {{every_ms: 1500}}}}}}\n"
        "plc:\n  tasks: {slow: {interval_ms: 1000}, edge: {single: m1.ready}}\n  programs:\n"
        "    one: {source: 'python: a.very.long.module.name.of.a.plant.logic:Class<Of>It', inputs: {a: {tag: m1.distance}}}\n"
        "    two: {source: two.st, task: edge}\n"
        "bridge:\n  office: {url: 'tcp://127.0.0.1:5020', units: {9: b/1, 8: a/3}}\n"
    )
    played = "".join(f"  m{n}: {{model: profile}}\n" for n in range(1, 12))
    (folder / "many.prototype.yaml").write_text(
        f"prototype_of: many.yaml\nbuses: {{a: {{listen: 'pty:a'}}, b: plant}}\ndevices:\n{played}"
    )
    return folder / "many.yaml"


def test_facts_are_those_of_the_file():
    observatory = of("observatory")
    line, can, lan = observatory.wires
    assert (line.kind, line.endpoint, line.stand_in) == (
        "serial line", "rtu:/dev/ttyS0?baudrate=19200&frame=8E1", "pty:line1",
    )  # fmt: skip
    assert (can.kind, can.rate) == ("CAN bus", "125 kbit/s")
    assert [s.asked for w in observatory.wires for s in w.stations] == [
        "every 500 ms, 1 s", "TPDO1 every 100 ms", "every 200 ms, 2 s",
    ]  # fmt: skip
    assert line.stations[0].writable == ("sample_period_s",)
    assert lan.stations[0].far == "topside end: 400 byte/s, 200 ms, 5 % lost"
    assert observatory.servers[0].endpoint == "tcp://127.0.0.1:0"  # a prototype takes a free port


def test_a_plant_shows_nothing_that_is_emulated():
    plant = of("observatory", prototype=False)
    assert all(not wire.stand_in and not any(s.plays for s in wire.stations) for wire in plant.wires)
    assert plant.servers[0].endpoint == "tcp://127.0.0.1:1502"
    assert 'class="line emulated"' not in svg(plant)
    assert "pty" not in svg(plant) + tree(plant)


def test_tasks_bridges_and_a_bus_of_the_plant_in_a_prototype(many: Path):
    wires = of(many)
    assert [p.cycle for p in wires.programs] == ["every 1 s", "at m1.ready"]
    assert wires.servers[0].offers == "units of a, b"
    assert wires.wires[1].stand_in == ""
    assert wires.wires[1].stations[0].plays == ""
    drawn = svg(wires)
    assert 'class="line"' in drawn
    assert 'class="line emulated"' in drawn


@pytest.mark.parametrize("name", SHIPPED)
def test_the_picture_and_the_text_have_every_bus_device_and_program(name: str):
    wires = of(name)
    texts = [node.text for node in ElementTree.fromstring(svg(wires)).iter() if node.tag.endswith("}text")]
    told = tree(wires)
    for wire in wires.wires:
        assert wire.endpoint in texts
        assert wire.endpoint in told
        for station in wire.stations:
            assert station.name in texts
            assert f"─ {station.name}" in told
    assert {program.name for program in wires.programs} <= set(texts)


def test_many_devices_go_into_rows_inside_the_picture(many: Path):
    root = ElementTree.fromstring(svg(of(many)))
    boxes = [node.attrib for node in root.iter() if node.tag.endswith("}rect") and "emulated" in node.get("class", "")]
    assert len(boxes) == 11
    assert len({box["y"] for box in boxes}) > 1
    assert len({(box["x"], box["y"]) for box in boxes}) == 11
    right = max(float(box["x"]) + float(box["width"]) for box in boxes)
    assert right <= float(root.attrib["width"]) <= ROOM + 40


def test_a_long_text_is_cut_and_whole_where_it_is_pointed_at(many: Path):
    drawn = svg(of(many))
    assert "<title>python: a.very.long.module.name.of.a.plant.logic:Class&lt;Of&gt;It</title>" in drawn
    assert "Class<Of>It" not in drawn


def test_nothing_in_the_picture_is_from_elsewhere():
    drawn = svg(of("observatory"))
    assert not re.findall(r"href|url\(|@import|<script", drawn)
    assert "prefers-color-scheme: dark" in drawn


def test_lines_stay_in_a_narrow_terminal():
    for name in SHIPPED:
        leaves = [line for line in tree(of(name), 80).splitlines() if "://" not in line]
        assert max(map(len, leaves)) <= 80


PICTURES = sorted((ROOT / "docs" / "pictures" / "wires").glob("*.svg"))


@pytest.mark.parametrize("picture", PICTURES, ids=lambda path: path.stem)
def test_a_picture_of_the_book_is_of_today_and_on_its_page(picture: Path):
    command = f"fieldtwin draw {picture.stem} --prototype -o docs/pictures/wires/{picture.name}"
    network = group_file(picture.stem)
    today = water.svg(water.network_map(load_network(network[1]))) if network else svg(of(picture.stem))
    assert picture.read_text("utf-8") == today, command
    assert any(f"pictures/wires/{picture.name})" in page.read_text("utf-8") for page in (ROOT / "docs").rglob("*.md"))


def test_the_book_has_the_wires_of_each_kind_of_system():
    assert {picture.stem for picture in PICTURES} >= {"observatory", "lab_vehicle", "silage_tractor"}


def network(folder: Path, range_m: float, *ats: str) -> water.Map:
    systems = ("west", "middle", "east")
    members = "".join(
        f"  {name}: {{system: ocean_{name}.yaml, modem: modem, at_m: {at}}}\n"
        for name, at in zip(systems, ats, strict=False)
    )
    path = folder / "sea.yaml"
    path.write_text(
        f"fieldtwin: 1\nnetwork: sea\nwater: {{range_m: {range_m}, sound_m_per_s: 1500}}\nsystems:\n{members}"
    )
    return water.network_map(load_network(path))


def test_a_network_is_a_map_of_receivers(tmp_path: Path):
    sea = network(tmp_path, 3000, "[0, 0, -300]", "[3000, 0, -300]", "[3000, 4000, -300]")
    assert [(way.one, way.other, way.said) for way in sea.ways] == [("west", "middle", "3.0 km, 2.0 s")]
    told = water.text(sea).splitlines()
    assert told[-1].endswith("hears nobody")
    assert told[-2].endswith("hears west (3.0 km, 2.0 s)")
    root = ElementTree.fromstring(water.svg(sea))
    dots = [(float(n.attrib["cx"]), float(n.attrib["cy"])) for n in root.iter() if n.tag.endswith("}circle")]
    assert dots[0][1] == dots[1][1] > dots[2][1]  # north is up
    assert dots[1][0] - dots[0][0] == pytest.approx((dots[1][1] - dots[2][1]) * 3 / 4, abs=0.3)  # one scale


def test_places_that_are_one_are_drawn_all_the_same(tmp_path: Path):
    sea = network(tmp_path, 100, "[5, 5]", "[5, 5]")
    assert sea.ways[0].distance_m == 0
    ElementTree.fromstring(water.svg(sea))


def test_the_command_prints_text_data_or_a_picture(tmp_path: Path):
    def said(*words: str) -> str:
        done = CliRunner().invoke(cli, ["draw", *words], standalone_mode=False)
        assert done.exception is None, done.output
        return done.stdout

    assert said("observatory").startswith("observatory (plant)\n")
    assert json.loads(said("observatory", "--prototype", "--json"))["wires"][0]["stand_in"] == "pty:line1"
    assert said("observatory", "-o", "-").startswith("<svg")
    assert said("ocean_network").startswith("ocean (network of prototypes)\n")
    assert said("observatory", "--prototype", "-o", str(tmp_path / "o.svg")) == ""
    assert (tmp_path / "o.svg").read_text("utf-8") == svg(of("observatory"))
