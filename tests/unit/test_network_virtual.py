"""A network in virtual time: one seed, one run; each system judged as it is alone; and what is not well is said."""

from __future__ import annotations

import json
from pathlib import Path

from click.testing import CliRunner

from fieldtwin.cli.main import cli
from fieldtwin.report.model import Verdict
from fieldtwin.running.shore import Scripted
from fieldtwin.running.virtual_network_run import VirtualNetworkOptions, VirtualNetworkRun
from fieldtwin.running.virtual_scenario import run_virtual
from fieldtwin.scenarios.form import load_scenario
from fieldtwin.scenarios.trace import read_trace
from twin.network import load_network

SHIPPED = Path(__file__).resolve().parents[2] / "profiles" / "systems" / "ocean_network.yaml"


def run(seed: int, trace: Path | None = None) -> VirtualNetworkRun:
    options = VirtualNetworkOptions(12.0, seed, commands=(Scripted(0.5, 3),), trace=trace)
    made = VirtualNetworkRun(load_network(SHIPPED), options)
    made.run()
    return made


def test_the_same_seed_is_the_same_run_and_everything_is_judged(tmp_path: Path) -> None:
    file = tmp_path / "trace.jsonl"
    first = run(5, file).summary()
    assert first["ok"], first
    assert run(5).summary() == first
    assert run(6).summary()["trace"] != first["trace"]
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
    assert {event.where.partition(".")[0] for event in events} == {"west", "middle", "east", "far end"}
    assert [event.t_ns for event in events if event.t_ns < 0] == []


def test_a_run_on_the_command_line() -> None:
    words = ["run", "ocean_network", "--prototype", "--virtual", "--for", "3s", "--commands", "none"]
    result = CliRunner().invoke(cli, [*words, "--json"], standalone_mode=False)
    summary = json.loads(result.stdout)
    assert summary["ok"]
    assert summary["ship"]["commands_sent"] == []
    assert {name: one["states"]["adapt"] for name, one in summary["systems"].items()} == {
        "west": ["STANDBY"], "middle": ["STANDBY"], "east": ["STANDBY"],
    }  # fmt: skip


def test_faults_of_a_system_and_of_the_water_are_put_in_where_they_are_aimed(tmp_path: Path) -> None:
    path = tmp_path / "x.scenario.yaml"
    path.write_text(
        "scenario: x\nsystem: ocean_network\nseed: 5\nsteps:\n"
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
