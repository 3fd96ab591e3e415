"""A network in virtual time: one seed gives one run; each system is checked as it is alone; problems are reported."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from fieldtwin.acoustic.network import load_network
from fieldtwin.acoustic.schema import WATER
from fieldtwin.cli.main import cli
from fieldtwin.emulators.faults.schema import parse_fault
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.results.model import Verdict
from fieldtwin.results.trace import read_trace
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.run.virtual.fault_schedule import CALM_S, random_schedule
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun
from fieldtwin.scenarios.language.form import load_scenario

SHIPPED = Path(__file__).resolve().parents[2] / "profiles" / "systems" / "ocean_network.yaml"


def run(seed: int, trace: Path | None = None) -> VirtualRun:
    made = VirtualRun(VirtualOptions(str(SHIPPED), 12.0, seed, commands=(3,), trace=trace))
    made.run()
    return made


def test_the_same_seed_gives_the_same_run_and_everything_is_checked(tmp_path: Path) -> None:
    file = tmp_path / "trace.jsonl"
    first = run(5, file).summary()
    assert first["ok"], first
    assert run(5).summary() == first
    assert run(9).summary()["trace"] != first["trace"]  # the acoustic channel loses a different message
    assert list(first["systems"]) == ["west", "middle", "east"]
    for name, one in first["systems"].items():
        assert one["published"]["checked"] > 10, name
        assert one["published"]["wrong"] == 0
        for bus, row in one["exchanges"].items():
            assert row["gateway"] == row["emulators"], (name, bus)
        assert one["outputs_safe"]
    assert first["systems"]["middle"]["states"] == {"adapt": ["STANDBY", "ACTIVE"]}
    assert first["water"]["middle"]["heard"] >= 2
    events = read_trace(file.read_bytes().splitlines())
    assert len(events) == first["trace"]["events"]
    assert {event.where.partition(".")[0] for event in events} == {"west", "middle", "east", "topside"}
    assert [event.t_ns for event in events if event.t_ns < 0] == []


def test_a_run_on_the_command_line() -> None:
    words = ["simulate", "ocean_network", "--for", "3s", "--commands", "none"]
    result = CliRunner().invoke(cli, [*words, "--json"], standalone_mode=False)
    summary = json.loads(result.stdout)
    assert summary["ok"]
    assert summary["ship"]["commands_sent"] == []
    assert {name: one["states"]["adapt"] for name, one in summary["systems"].items()} == {
        "west": ["STANDBY"], "middle": ["STANDBY"], "east": ["STANDBY"],
    }  # fmt: skip


FAULTS = """faults:
  - {id: mute, name: silence, device: middle.optode, from: 1, until: 4}
  - {id: deaf, name: drop, bus: water, device: middle, from: 0, until: 9}
"""


def on_the_command_line(folder: Path, *words: str) -> Any:
    (folder / "f.yaml").write_text(FAULTS)
    line = ["simulate", "ocean_network", *words]
    return CliRunner().invoke(cli, line, standalone_mode=False)


def test_a_run_with_a_file_of_faults(tmp_path: Path) -> None:
    result = on_the_command_line(tmp_path, "--for", "10s", "--faults", str(tmp_path / "f.yaml"), "--json")
    summary = json.loads(result.stdout)
    timeouts = {
        name: sum(row["timeouts"] for row in one["exchanges"].values()) for name, one in summary["systems"].items()
    }
    assert timeouts.pop("middle") > 0
    assert timeouts == {"west": 0, "east": 0}
    assert summary["water"]["middle"]["fault"] > 0
    assert summary["water"]["east"]["fault"] == 0


def test_a_fault_without_a_target_is_an_error_with_its_place(tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_text("faults:\n  - {name: silence, device: middel.optode}\n")
    result = on_the_command_line(tmp_path, "--for", "10s", "--faults", str(tmp_path / "x.yaml"))
    assert isinstance(result.exception, FileInvalid)
    assert result.exception.line == 2
    assert "middle.optode" in str(result.exception)


def test_a_seed_chooses_faults_of_all_systems_and_of_the_acoustic_channel() -> None:
    network = load_network(SHIPPED)
    found = random_schedule(network, 3, 20_000.0)
    assert found == random_schedule(network, 3, 20_000.0) != random_schedule(network, 4, 20_000.0)
    assert {where for where, faults in network.place(found).items() if faults} == {WATER, *network.members}
    assert len({fault["id"] for fault in found}) == len(found)
    assert list(found) == sorted(found, key=lambda fault: fault["from"])
    for number, said in enumerate(found, 1):
        spec = parse_fault(dict(said), number=number)
        network.check_fault(spec)
        assert spec.until_s is not None
        assert spec.until_s <= 20_000 - CALM_S


def test_many_seeds_run_and_the_ledger_skips_its_entries(tmp_path: Path) -> None:
    words = ("--for", "3s", "--seeds", "1..2", "--ledger", str(tmp_path / "l"), "--commands", "none", "--json")
    first = json.loads(on_the_command_line(tmp_path, *words).stdout)
    assert [one["seed"] for one in first["results"]] == [1, 2]
    assert first["failed"] == []
    assert all(one["checked"] > 10 for one in first["results"])
    assert json.loads(on_the_command_line(tmp_path, *words).stdout)["results"] == []
    again = on_the_command_line(tmp_path, *words, "--seed", "3")
    assert isinstance(again.exception, UsageError)


@pytest.mark.long
def test_the_minimal_faults_of_a_failing_seed_become_a_scenario_of_the_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wrong bits on Modbus TCP, which has no checksum: they cannot be detected, and the published values are wrong."""
    monkeypatch.chdir(tmp_path)
    bits = "  - {id: bits, name: corrupt-bits, device: west.modem, from: 0, until: 20}\n"
    (tmp_path / "x.yaml").write_text(FAULTS + bits)
    result = on_the_command_line(tmp_path, "--for", "20s", "--faults", "x.yaml", "--seeds", "1")
    assert result.return_value == 1
    assert "published values never occurred in their device" in result.stdout
    scenario = load_scenario(tmp_path / "ocean_network-seed1.scenario.yaml")
    assert [step.fault["id"] for step in scenario.form.steps if step.fault] == ["bits"]
    again = run_virtual(scenario)
    assert again.verdict is Verdict.FAILED
    assert "published values never occurred in their device" in again.reason


def test_faults_of_a_system_and_of_the_acoustic_channel_affect_their_targets(tmp_path: Path) -> None:
    path = tmp_path / "x.scenario.yaml"
    path.write_text(
        "scenario: x\nsystem: ocean_network\nseed: 5\nsteps:\n"
        "  - wait: {until: \"quality(middle.optode.status) == 'good'\", within: 20s}\n"
        "  - fault: {id: mute, name: silence, device: middle.optode}\n"
        "  - fault: {id: deaf, name: drop, bus: water, device: middle}\n"
        "  - expect: {tag: middle.optode.status, quality: bad, within: 40s}\n"
        "  - expect: {that: \"quality(west.ctd.status) == 'good' and quality(east.current.status) == 'good'\"}\n"
        "  - send: {period_s: 4}\n"
        "  - wait: {until: 'west.adapt.base_s == 4', within: 20s}\n"
        "  - expect: {that: 'middle.adapt.base_s == 0', during: 5s}\n"
        "  - clear: deaf\n"
        "  - clear: mute\n"
        "  - wait: {until: 'middle.adapt.base_s == 4', within: 120s}\n"
        "  - expect: {wire: middle.optode, function: 16, register: sample_period_s, value: 4, within: 15s}\n"
        "  - set: {tag: east.current.speed, value: 1.5}\n"
        "  - expect: {tag: east.current.speed, value: 1.5, tolerance: 0.001, within: 60s}\n"
    )
    result = run_virtual(load_scenario(path))
    assert result.verdict is Verdict.PASSED, [(c.text, c.expected, c.got) for c in result.checks]
    assert result.counts is not None
    assert result.counts.faults == {"silence": 1, "drop": 1}
    assert any(device == "west.ctd" for device, *_ in result.counts.touched)
