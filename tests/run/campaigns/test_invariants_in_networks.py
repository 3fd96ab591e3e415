"""Invariants and campaigns in networks and with every target are checked, or the combination is refused with the reason."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from fieldtwin.cli.run.run_command import command as run_command
from fieldtwin.cli.run.simulate_command import command as simulate_command
from fieldtwin.cli.test.test_command import command as judge_command
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.run.campaigns.confirming import CONFIRMED

SYSTEMS = Path(__file__).resolve().parents[3] / "profiles" / "systems"
SCENARIO = """scenario: every observatory goes to work
system: ocean_network.yaml
seed: 2
steps:
  - send: {from: ship, period_s: 10}
  - wait: {until: "east.adapt.state == 'ACTIVE' and middle.adapt.state == 'ACTIVE'", within: 60s}
"""
ACTIVE = """
invariants:
  never: ["adapt.state == 'ACTIVE'"]
"""
READ = """
invariants:
  never: ["quality(ctd.status) == 'bad'"]
"""
RANDOM = ("--faults", "random", "--fault-every", "30s", "--fault-kinds", "silence", "--fault-aims", "west.ctd")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for path in (*SYSTEMS.glob("ocean*.yaml"), SYSTEMS / "adapt.st"):
        if not path.name.endswith(".scenario.yaml"):
            shutil.copy(path, tmp_path)
    (tmp_path / "active.scenario.yaml").write_text(SCENARIO)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def add(folder: Path, member: str, text: str) -> None:
    path = folder / f"ocean_{member}.yaml"
    path.write_text(path.read_text() + text)


def judge(*words: str) -> tuple[int, list[dict[str, Any]]]:
    told = CliRunner().invoke(judge_command, [*words, "--json"], standalone_mode=False)
    if told.exception is not None:
        raise told.exception
    return told.return_value, json.loads(told.stdout)


def test_a_broken_invariant_of_a_member_fails_the_scenario_of_the_network(folder: Path) -> None:
    add(folder, "west", READ)
    code, (result,) = judge("active.scenario.yaml")
    assert (code, result["verdict"]) == (0, "passed"), result
    assert [c["verdict"] for c in result["checks"] if c["number"] == "west.invariant never 1"] == ["passed"]
    add(folder, "middle", ACTIVE)
    code, (result,) = judge("active.scenario.yaml")
    assert (code, result["verdict"]) == (1, "failed")
    assert result["reason"].startswith("middle.invariant never 1: ")
    broken = next(check for check in result["checks"] if check["verdict"] == "failed")
    assert "ocean_middle.yaml:" in broken["where"]


def test_a_run_of_a_network_with_a_broken_invariant_is_not_ok(folder: Path) -> None:
    add(folder, "middle", ACTIVE)
    words = ["ocean_network.yaml", "--for", "60s", "--json"]
    told = CliRunner().invoke(simulate_command, words, standalone_mode=False)
    summary = json.loads(told.stdout)
    assert (told.return_value, summary["ok"]) == (1, False)
    assert [one["verdict"] for one in summary["systems"]["middle"]["invariants"]] == ["failed"]
    assert summary["systems"]["west"]["invariants"] == []


@pytest.mark.long
@pytest.mark.timeout(300)  # two campaigns of three systems, each with the search for causes and runs for traces
def test_random_faults_break_an_invariant_of_a_member_and_are_shrunk(folder: Path) -> None:
    add(folder, "west", READ)
    code, results = judge("active.scenario.yaml", "--seeds", "1..2", "--for", "4min", *RANDOM)
    assert code == 1
    broken = [result for result in results if result["verdict"] == "failed"]
    assert broken
    assert all("west.invariant never 1" in json.dumps(result) for result in broken)
    assert any(fault["struck"] for result in broken for fault in result["faults"])
    (path,) = folder.glob("active-seed*.scenario.yaml")
    code, (again,) = judge(str(path))
    assert (code, again["verdict"]) == (1, "failed"), again
    told = CliRunner().invoke(judge_command, ["active.scenario.yaml", "--seeds", "1..2", "--for", "4min", *RANDOM])
    assert CONFIRMED in told.output


@pytest.mark.parametrize(
    "words", [("--target", "local"), ("--target", "compose"), ("--target", "real"), ("--with", "--", "true")]
)
@pytest.mark.parametrize("faults", [(), ("--faults", "random")])
@pytest.mark.parametrize("file", ["active.scenario.yaml", str(SYSTEMS / "ctd-silent.scenario.yaml")])
def test_a_campaign_outside_of_virtual_time_is_refused(
    folder: Path, words: tuple[str, ...], faults: tuple[str, ...], file: str
) -> None:
    done = CliRunner().invoke(judge_command, [file, "--seeds", "1..2", *faults, *words], standalone_mode=False)
    assert isinstance(done.exception, UsageError), done.output
    assert "--seeds needs virtual time" in str(done.exception)
    assert done.exception.expected == "--target virtual, without --with"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--prototype", "--faults", "random"), "`fieldtwin run` has no --faults random: use `fieldtwin simulate"),
        (("--prototype", "--seeds", "1..2"), "`fieldtwin run` has no --seeds: use `fieldtwin simulate"),
    ],
)
@pytest.mark.parametrize("system", ["observatory", "ocean_network"])
def test_random_faults_of_a_run_outside_of_virtual_time_are_refused(
    folder: Path, system: str, words: tuple[str, ...], told: str
) -> None:
    done = CliRunner().invoke(run_command, [system, *words, "--for", "3s"], standalone_mode=False)
    assert isinstance(done.exception, UsageError), done.output
    assert told in str(done.exception)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--target", "compose"), "a network runs as prototypes, on --target virtual or local only, not on compose"),
        (("--target", "real"), "a network runs as prototypes, on --target virtual or local only, not on real"),
        (("--with", "--", "true"), "--with starts one program"),
    ],
)
def test_a_network_on_a_target_that_cannot_is_skipped_with_the_reason(
    folder: Path, words: tuple[str, ...], told: str
) -> None:
    add(folder, "middle", ACTIVE)
    options = words[: words.index("--with")] if "--with" in words else words
    rest = words[len(options) :]
    done = CliRunner().invoke(judge_command, ["active.scenario.yaml", *options, "--json", *rest], standalone_mode=False)
    assert done.return_value == 1
    (result,) = json.loads(done.stdout)
    assert result["verdict"] == "skipped"
    assert told in result["reason"]
