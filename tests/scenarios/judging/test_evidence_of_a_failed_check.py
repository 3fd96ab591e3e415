"""A scenario that did not pass shows the traffic before the failed check: in terminal, JSON, JUnit and pytest."""

from __future__ import annotations

import json
import re
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from click.testing import CliRunner

from fieldtwin.cli.test import test_command
from fieldtwin.scenarios.judging.last_exchanges import MOST

pytest_plugins = ["pytester"]
PROFILE = """device: fieldtwin/tank
source: "made for this test"
protocol: modbus
numbering: sent
tags:
  level: {at: "holding:0", poll: level}
  pin:   {at: "holding:9", poll: pin, secret: true}
"""
PLANT = """fieldtwin: 1
system: plant
buses:
  lan: {url: "tcp://192.0.2.1:502"}
devices:
  sensor: {profile: tank.yaml, bus: lan, unit: 1, poll: {level: {every_ms: 100}, pin: {every_ms: 1000}}}
  other:  {profile: tank.yaml, bus: lan, unit: 2, poll: {level: {every_ms: 100}, pin: {every_ms: 1000}}}
plc:
  cycle_ms: 100
  programs:
    pump: {source: pump.st, inputs: {level: {tag: sensor.level}}}
"""
PROTOTYPE = """prototype_of: plant.yaml
buses:
  lan: {listen: "tcp://127.0.0.1:0"}
devices:
  sensor: {model: profile, values: {level: 42, pin: 4711}}
  other:  {model: profile, values: {level: 7, pin: 815}}
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
STEPS = "  - pause: 10s\n  - expect: {that: 'sensor.level == 43'}\n"


def plant(folder: Path, steps: str = STEPS) -> Path:
    (folder / "tank.yaml").write_text(PROFILE)
    (folder / "plant.yaml").write_text(PLANT)
    (folder / "pump.st").write_text(LOGIC)
    (folder / "plant.prototype.yaml").write_text(PROTOTYPE)
    path = folder / "x.scenario.yaml"
    path.write_text(f"scenario: the level is 43\nsystem: plant.yaml\nsteps:\n{steps}")
    return path


def said(*words: str) -> str:
    done = CliRunner().invoke(test_command.command, words, standalone_mode=False)
    assert done.exception is None, done.output
    return done.stdout


def test_terminal_json_and_junit_show_the_last_exchanges_and_how_many_were_left_out(tmp_path: Path) -> None:
    path = plant(tmp_path)
    text = said(str(path), "--junit", str(tmp_path / "out.xml"))
    heading = re.search(
        r"exchanges with sensor in the 5 s before the failed check \((\d+) earlier .* left out\):", text
    )
    assert heading, text
    (plain,) = json.loads(said(str(path), "--json"))
    lines = plain["on_the_wire"]
    assert len(lines) == MOST + 1
    assert lines[0] == heading[0]
    # each second: ten polls of the level and one of the PIN
    assert int(heading[1]) + MOST == pytest.approx(5 * (10 + 1), abs=3)
    failed_s = plain["checks"][-1]["t_s"]
    for line in lines[1:]:
        at, request, _ = re.fullmatch(r"([\d.]+) s  (.+) -> (.+)", line).groups()  # type: ignore[union-attr]
        assert failed_s - 5 <= float(at) <= failed_s
        assert request.startswith("sensor: "), line
        assert line in text
    assert any("level 42" in line for line in lines)
    assert not any("4711" in line for line in lines), "the value of a secret tag is shown"
    failure = next(ET.parse(tmp_path / "out.xml").iter("failure")).text or ""
    assert lines[-1] in failure


def test_a_check_that_names_no_device_shows_all_of_them(tmp_path: Path) -> None:
    steps = "  - pause: 10s\n  - expect: {that: 'sensor.level + other.level == 43'}\n"
    (plain,) = json.loads(said(str(plant(tmp_path, steps)), "--json"))
    assert plain["on_the_wire"][0].startswith("exchanges with other, sensor in the 5 s")
    (plain,) = json.loads(said(str(plant(tmp_path, "  - pause: 10s\n")), "--json"))
    assert plain["verdict"] == "inconclusive"
    assert plain["on_the_wire"] == []  # it has no expectation, so no check can fail


def test_a_wire_without_traffic_is_reported_as_silent(tmp_path: Path) -> None:
    path = plant(tmp_path, "  - pause: 12s\n  - expect: {that: 'sensor.level == 43'}\n")
    (tmp_path / "plant.yaml").write_text(re.sub(r"every_ms: \d+", "every_ms: 60000", PLANT))
    (plain,) = json.loads(said(str(path), "--json"))
    assert plain["on_the_wire"] == ["no exchange in the 5 s before the failed check"]


def test_a_request_that_got_no_reply_is_shown_as_such(tmp_path: Path) -> None:
    steps = "  - fault: {name: drop, bus: lan, id: lost}\n" + STEPS
    (plain,) = json.loads(said(str(plant(tmp_path, steps)), "--json"))
    assert any(re.search(r"sensor: .* -> no reply so far$", line) for line in plain["on_the_wire"]), plain[
        "on_the_wire"
    ]


def test_a_passing_scenario_shows_no_frames(tmp_path: Path) -> None:
    (plain,) = json.loads(said(str(plant(tmp_path, STEPS.replace("43", "42"))), "--json"))
    assert (plain["verdict"], plain["on_the_wire"]) == ("passed", [])


LOADED = ("-p", "fieldtwin.pytest_plugin", "-p", "no:randomly", "-p", "no:hypothesispytest")


@pytest.mark.long
def test_a_failed_assertion_of_the_pytest_fixture_prints_the_exchanges_on_lines(pytester: pytest.Pytester) -> None:
    plant(pytester.path)
    pytester.makepyfile(
        test_one="""
        def test_level(scenario):
            assert scenario("x.scenario.yaml")
        """
    )
    done = pytester.runpytest_inprocess(*LOADED, "test_one.py", "--junit-xml=out.xml")
    done.assert_outcomes(failed=1)
    done.stdout.fnmatch_lines(["*exchanges with sensor in the 5 s before the failed check (*", "*sensor: *level 42*"])
    failure = next(ET.parse(pytester.path / "out.xml").iter("failure")).text or ""
    assert "sensor: " in failure, "the text of the failure in JUnit lacks the exchanges"
    for text in (done.stdout.str(), failure):
        assert "\\n" not in text


def test_a_reason_of_several_lines_is_on_one_line_in_the_assertion(pytester: pytest.Pytester) -> None:
    from fieldtwin.testing.outcome import ScenarioOutcome

    assert repr(ScenarioOutcome("x", "error", "the device is gone\nhint: look at it")) == (
        "<error scenario 'x': the device is gone hint: look at it>"
    )
