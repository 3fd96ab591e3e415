"""`fieldtwin test` names, after a failure, the commands that show all events of the run."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from fieldtwin.cli.main import cli

TANK = "device: mysite/tank\nprotocol: modbus\nsource: invented\ntags: {level: {at: 30001, type: uint16}}\n"
SYSTEM = """
fieldtwin: 1
system: hall
buses: {lan: {url: "tcp://192.0.2.1:502"}}
devices: {tank: {profile: ./tank.yaml, bus: lan, unit: 1, poll: {values: {every_ms: 100}}}}
"""
PROTOTYPE = """
prototype_of: hall.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices: {tank: {model: profile}}
"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name, text in (("tank.yaml", TANK), ("hall.yaml", SYSTEM), ("hall.prototype.yaml", PROTOTYPE)):
        (tmp_path / name).write_text(text)
    for name, level in (("high", 5), ("low", 0)):
        steps = f"  - pause: 1s\n  - expect: {{tag: tank.level, value: {level}}}\n"
        (tmp_path / f"{name}.scenario.yaml").write_text(f"scenario: {name}\nsystem: hall.yaml\nsteps:\n{steps}")
    return tmp_path


def run(*words: str) -> Result:
    return CliRunner().invoke(cli, ["test", *words], standalone_mode=False, catch_exceptions=False)


def test_the_commands_for_a_trace_follow_a_failure_and_reproduce_it(site: Path) -> None:
    done = run("high.scenario.yaml", "low.scenario.yaml")
    hint = done.stderr.splitlines()[-1]
    assert hint == (
        "all events: fieldtwin test high.scenario.yaml --seed 1 --trace fail.jsonl; fieldtwin studio fail.jsonl"
    )
    again = hint.removeprefix("all events: fieldtwin test ").partition(";")[0].split()
    assert run(*again).return_value == 1
    assert (site / "fail.jsonl").exists()


def test_the_trace_of_a_failure_is_named(site: Path) -> None:
    assert run(".", "--traces", "traces").stderr == "all events: fieldtwin studio traces/high.jsonl\n"


@pytest.mark.parametrize("words", [("low.scenario.yaml",), ("high.scenario.yaml", "--json")])
def test_a_pass_and_json_have_no_hint(site: Path, words: tuple[str, ...]) -> None:
    assert run(*words).stderr == ""
