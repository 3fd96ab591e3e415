"""A report of scenarios of several systems shows each scenario with its own system: its secrets, devices and name.

Defect: the HTML report used the first file's system for all. Secret tags of the others were shown in diagrams and frames.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from click.testing import CliRunner

from fieldtwin.cli.test.test_command import command

PROFILE = """device: fieldtwin/TANK
source: "made for this test"
protocol: modbus
numbering: sent
tags:
  level: {at: "holding:0", poll: all}
  NAME:  {at: "holding:1", poll: all}
"""
PLANT = """fieldtwin: 1
system: SYSTEM
buses:
  lan: {url: "tcp://192.0.2.1:502"}
devices:
  tank: {profile: TANK.yaml, bus: lan, unit: 1, poll: {all: {every_ms: 500}}}
plc:
  cycle_ms: 100
  programs:
    pump: {source: SYSTEM.st, inputs: {level: {tag: tank.level}}}
"""
PROTOTYPE = """prototype_of: SYSTEM.yaml
buses:
  lan: {listen: "tcp://127.0.0.1:0"}
devices:
  tank: {model: profile, values: {level: 3, NAME: 48813}}
"""
LOGIC = """PROGRAM Pump
VAR_INPUT
  level : INT;
END_VAR
VAR
  full : BOOL;
END_VAR
  full := level > 50;
END_PROGRAM
"""
SCENARIO = """scenario: the level of SYSTEM
system: SYSTEM.yaml
steps:
  - pause: 5s
  - expect: {that: "tank.level == 4 and tank.NAME == 1"}
"""
SECRET = re.compile(r"48813|bead|be ad", re.IGNORECASE)  # the value, and its register on the wire


def site(folder: Path) -> list[str]:
    for system, name in (("first", "flow"), ("second", "pin")):
        texts = {
            f"{system}-tank.yaml": PROFILE,
            f"{system}.yaml": PLANT,
            f"{system}.prototype.yaml": PROTOTYPE,
            f"{system}.st": LOGIC,
            f"{system}.scenario.yaml": SCENARIO,
        }
        for file, text in texts.items():
            text = text.replace("NAME", name).replace("SYSTEM", system).replace("TANK", f"{system}-tank")
            secret = 'pin:  {at: "holding:1", secret: true,'
            (folder / file).write_text(text.replace('pin:  {at: "holding:1",', secret))
    return [str(folder / f"{system}.scenario.yaml") for system in ("first", "second")]


@pytest.mark.parametrize("turned", [False, True])
def test_each_scenario_is_shown_with_its_own_system(tmp_path: Path, turned: bool) -> None:
    files = site(tmp_path)
    files = files[::-1] if turned else files
    words = [*files, "--html", str(tmp_path / "r.html"), "--junit", str(tmp_path / "r.xml")]
    done = CliRunner().invoke(command, words, standalone_mode=False)
    assert done.return_value == 1, done.output
    page = (tmp_path / "r.html").read_text()
    sections = re.split(r'<section class="failure"', page)
    assert len(sections) == 3
    shown = {name: next(s for s in sections[1:] if f"the level of {name}" in s) for name in ("first", "second")}
    shown["second"] = shown["second"].partition("</section>")[0]
    assert "tank.pin" in shown["second"]
    assert not SECRET.search(shown["second"]), "a secret of the second system is shown"
    assert not SECRET.search(done.output[done.output.index("the level of second") :].partition("the level of first")[0])
    assert "48813" in shown["first"]  # not a secret there
    assert "first-tank" in page
    assert "second-tank" in page
    for name in ("first", "second"):
        assert f"{name} ({name}.yaml" in page
    classes = {
        case.get("name", "").split(" [")[0]: case.get("classname")
        for case in ET.parse(tmp_path / "r.xml").iter("testcase")
    }
    assert classes == {"the level of first": "first.virtual", "the level of second": "second.virtual"}
    assert not SECRET.search(
        (tmp_path / "r.xml").read_text().partition("the level of second")[2].partition("testcase")[0]
    )


def test_one_system_alone_has_one_coverage(tmp_path: Path) -> None:
    (file, _) = site(tmp_path)
    CliRunner().invoke(command, [file, "--html", str(tmp_path / "r.html")], standalone_mode=False)
    page = (tmp_path / "r.html").read_text()
    assert page.count("Registers and objects") == 1
    assert "Coverage of" not in page
