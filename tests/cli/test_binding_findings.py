"""Findings about the bindings of a system's programs, in `fieldtwin plc check` and `fieldtwin test`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from click.testing import CliRunner, Result

from fieldtwin.cli.plc.check_command import check
from fieldtwin.cli.test.test_command import command
from fieldtwin.gateway.core.errors import UsageError

EXAMPLE = Path(__file__).parents[2] / "examples" / "first-bug"


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(EXAMPLE, tmp_path / "site")
    monkeypatch.chdir(tmp_path / "site")
    return tmp_path / "site"


def change(file: str, old: str, new: str) -> None:
    text = Path(file).read_text()
    assert old in text
    Path(file).write_text(text.replace(old, new, 1))


def bind_input(declaration: str, statement: str = "", profile: str = "", waiver: str = "") -> None:
    """Add an input `more` with a tag `sensor.more`."""
    change("fill.st", "VAR_INPUT", f"VAR_INPUT more : {declaration};")
    change("fill.st", "IF level", f"{statement}\n  IF level")
    if profile:
        Path("level.yaml").write_text(Path("level.yaml").read_text() + f"  more: {profile}\n")
    tag = "sensor.more" if profile else "sensor.level"
    change("tank.yaml", "inputs: {level: {tag: sensor.level, if_bad: hold}}", INPUTS.format(tag=tag, waiver=waiver))


INPUTS = """inputs:
        level: {{tag: sensor.level, if_bad: hold}}
        more: {{tag: {tag}}}{waiver}"""
USED = "run := more = 3;"


def warnings() -> list[str]:
    done = CliRunner().invoke(check, ["tank.yaml", "--json"], standalone_mode=False, catch_exceptions=False)
    found = json.loads(done.output)
    assert found["errors"] == []
    return [f"{one['path']}:{one['line']} {one['id']} {one['message']}" for one in found["warnings"]]


def run(*arguments: str) -> Result:
    return CliRunner().invoke(command, ["cycle.scenario.yaml", *arguments], standalone_mode=False)


def test_the_example_has_no_finding(site: Path) -> None:
    assert warnings() == []


def test_an_input_that_cannot_hold_every_value_of_its_tag(site: Path) -> None:
    bind_input("INT", USED, "{at: 30010, type: uint16}")
    assert warnings() == ["tank.yaml:21 ST111 sensor.more can be 0 to 65535, and more holds -32768 to 32767 only"]


@pytest.mark.parametrize("kind", ["UINT", "DINT", "INT (0..9)"])
def test_an_input_that_holds_every_value_of_its_tag(site: Path, kind: str) -> None:
    bind_input(kind, USED, "{at: 30010, type: uint16, range: [0, 9]}")
    assert warnings() == []


def test_an_output_that_is_a_wider_subrange_than_its_tag(site: Path) -> None:
    change("fill.st", "VAR_OUTPUT", "VAR_OUTPUT speed : INT (0..200);")
    change("starter.yaml", "tags:", "tags:\n  speed: {at: 40002, type: uint16, access: rw, range: [0, 100]}")
    change("tank.yaml", "outputs: {run: pump.run}", "outputs: {run: pump.run, speed: pump.speed}")
    change("tank.yaml", "writable: [run]", "writable: [run, speed]")
    found = [one for one in warnings() if "ST104" not in one]
    assert found == ["tank.yaml:20 ST111 speed can be 0 to 200, and pump.speed accepts 0 to 100 only"]


def test_an_input_that_no_statement_uses(site: Path) -> None:
    bind_input("REAL")
    assert warnings() == ["tank.yaml:21 ST112 sensor.level is bound to the input more, which no statement uses"]


def test_an_input_that_only_a_quality_check_uses(site: Path) -> None:
    bind_input("REAL", "IF NOT IS_GOOD(more) THEN run := FALSE; END_IF")
    assert warnings() == []


def test_a_time_that_is_bound_to_a_tag_in_milliseconds(site: Path) -> None:
    bind_input("TIME", "run := more > T#3s;", "{at: 30010, type: uint16, unit: ms}")
    (found,) = warnings()
    assert found == "tank.yaml:21 ST113 more is a TIME, which is bound as a number of ns, and sensor.more is in ms"


def test_a_writable_tag_that_nothing_writes(site: Path) -> None:
    change("starter.yaml", "tags:", "tags:\n  speed: {at: 40002, type: uint16, access: rw}")
    change("tank.yaml", "writable: [run]", "writable: [run, speed]")
    assert warnings() == ["tank.yaml:13 ST114 pump.speed is in `writable`, and no program and no server writes it"]
    tags = "{pump.speed: {holding: 0, type: uint16, write: true}}"
    served = f"serve:\n  hmi: {{kind: modbus, url: 'tcp://127.0.0.1:1502', tags: {tags}}}\n"
    Path("tank.yaml").write_text(Path("tank.yaml").read_text() + served)
    assert warnings() == []


def test_a_comment_in_the_system_file_accepts_a_finding(site: Path) -> None:
    bind_input("REAL", waiver="   # fieldtwin: allow ST112: for the next version")
    assert warnings() == []


def test_a_waiver_of_a_different_finding_does_not_count(site: Path) -> None:
    bind_input("REAL", waiver="   # fieldtwin: allow ST113: for the next version")
    assert [one.split()[1] for one in warnings()] == ["ST100", "ST112"]


def test_a_finding_fails_the_test_run_only_where_it_is_an_error(site: Path) -> None:
    bind_input("REAL")
    done = run("--findings", "f.json", "--json")
    assert done.return_value == 0, done.output
    assert [one["id"] for one in json.loads(Path("f.json").read_text())["warnings"]] == ["ST112"]
    done = run("--error", "st112", "--json", "--junit", "j.xml")
    assert done.return_value == 1
    of_check, of_scenario = json.loads(done.stdout)
    assert (of_check["name"], of_check["verdict"], of_scenario["verdict"]) == (
        "check of the programs",
        "failed",
        "passed",
    )
    assert [one["where"] for one in of_check["checks"]] == ["tank.yaml:21"]
    first, _ = ET.parse("j.xml").getroot().iter("testcase")
    assert first.find("failure") is not None


def test_a_waived_finding_is_listed_with_its_reason(site: Path) -> None:
    bind_input("REAL", waiver="   # fieldtwin: allow ST112: for the next version")
    done = run("--error", "all", "--json")
    assert done.return_value == 0
    (check,) = json.loads(done.stdout)[0]["checks"]
    assert (check["verdict"], check["reason"]) == ("skipped", "for the next version")


def test_an_unknown_id_is_refused(site: Path) -> None:
    done = run("--error", "ST999")
    assert isinstance(done.exception, UsageError)
    assert "an unknown warning" in str(done.exception)
