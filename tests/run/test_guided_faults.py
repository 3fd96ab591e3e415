"""Guided faults: chosen during the run by its coverage, and yet the same for the same seed on every computer."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from fieldtwin.cli.main import cli
from fieldtwin.emulators.faults.schema import parse_fault
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.results.trace import Trace, TraceEvent, TraceKind
from fieldtwin.run.campaigns.ledger import Ledger
from fieldtwin.run.campaigns.many_seeds import what_runs
from fieldtwin.run.virtual.fault_schedule import CALM_S, RandomFaults
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun

PROFILE = """device: test/sensor
source: "made for this test"
protocol: modbus
numbering: sent
tags:
  level: {at: "holding:0", poll: level}
"""
PLANT = """fieldtwin: 1
system: plant
buses:
  lan: {url: "tcp://192.0.2.1:502", timeout_ms: 200}
devices:
  sensor: {profile: sensor.yaml, bus: lan, unit: 1, poll: {level: {every_ms: 2000}}, stale_after_ms: 5000}
plc:
  cycle_ms: 1000
  programs:
    cycle: {source: cycle.st, inputs: {level: {tag: sensor.level}}}
"""
PROTOTYPE = """prototype_of: plant.yaml
buses:
  lan: {listen: "tcp://127.0.0.1:0"}
devices:
  sensor: {model: profile, values: {level: 42}}
"""
PROGRAM = """TYPE Phase : (WORKING, CHANGING); END_TYPE
PROGRAM Cycle
VAR_INPUT level : INT; END_VAR
VAR state : Phase; lost : BOOL; s : REAL; END_VAR
  s := s + 1.0;
  IF state = WORKING AND s >= 100.0 THEN state := CHANGING; s := 0.0;
  ELSIF state = CHANGING AND s >= 4.0 THEN state := WORKING; s := 0.0; END_IF;
  IF state = CHANGING AND NOT IS_GOOD(level) THEN lost := TRUE; END_IF;
END_PROGRAM
"""
SCENARIO = """scenario: the command is not lost while the pumps change
system: plant.yaml
never: ["cycle.lost"]
steps:
  - wait: {until: "cycle.state == 'WORKING'", within: 20s}
"""
LENGTH_S = 900.0
GUIDED = RandomFaults(60.0, guided=True)


@pytest.fixture
def plant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    for name, text in {
        "sensor.yaml": PROFILE,
        "plant.yaml": PLANT,
        "plant.prototype.yaml": PROTOTYPE,
        "cycle.st": PROGRAM,
        "change.scenario.yaml": SCENARIO,
    }.items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    return "plant.yaml"


def made(options: VirtualOptions) -> tuple[VirtualRun, list[TraceEvent]]:
    """Make a run. Return it with the events of its programs and tags."""
    events: list[TraceEvent] = []

    def watch(trace: Trace) -> None:
        trace.listen(events.append, TraceKind.STATE, TraceKind.TAG)

    run = VirtualRun(options)
    run.run(watch=watch)
    return run, events


@pytest.mark.parametrize(("system", "length_s", "mean_s"), [("plant.yaml", 300.0, 20.0), ("observatory", 60.0, 5.0)])
def test_a_seed_gives_the_same_run_again_and_its_faults_have_the_same_effect_as_a_fixed_schedule(
    plant: str, system: str, length_s: float, mean_s: float
) -> None:
    options = VirtualOptions(system, length_s, seed=5, random_faults=replace(GUIDED, mean_s=mean_s))
    first, events = made(options)
    assert len(first.faults) > 2
    assert first.trace.hexdigest() == made(options)[0].trace.hexdigest()
    fixed, again = made(replace(options, random_faults=None, faults=first.faults))
    assert again == events
    assert fixed.summary()["ok"] == first.summary()["ok"]


def test_a_run_has_as_many_faults_as_a_drawn_schedule_and_none_at_the_end(plant: str) -> None:
    runs = [made(VirtualOptions(plant, LENGTH_S, seed=seed, random_faults=GUIDED))[0] for seed in range(6)]
    for run in runs:
        assert len({fault["id"] for fault in run.faults}) == len(run.faults)
        for said in run.faults:
            spec = parse_fault(dict(said))
            run.group.check_fault(spec)
            assert spec.until_s is not None
            assert spec.from_s < spec.until_s <= LENGTH_S - CALM_S
    drawn = (LENGTH_S - CALM_S) / GUIDED.mean_s
    assert 0.7 * drawn < sum(len(run.faults) for run in runs) / len(runs) < 1.3 * drawn


def in_short_state(run: VirtualRun, events: list[TraceEvent]) -> float:
    """Return the part of the faults that begin while the pumps change, or in the 4 s before or after it."""
    begins = [e.t_ns / NS_PER_S for e in events if e.where == "cycle.state" and e.data["value"] == "CHANGING"]
    return sum(any(at - 4 <= fault["from"] <= at + 8 for at in begins) for fault in run.faults) / len(run.faults)


def test_a_short_state_gets_more_faults_than_at_random_times(plant: str) -> None:
    def part(wanted: RandomFaults) -> float:
        ended = [made(VirtualOptions(plant, LENGTH_S, seed=seed, random_faults=wanted)) for seed in range(6)]
        return sum(in_short_state(*one) for one in ended) / len(ended)

    assert part(GUIDED) > 1.5 * part(replace(GUIDED, guided=False))


def test_a_kind_without_an_effect_is_replaced(plant: str) -> None:
    """Of these kinds only a silence makes a tag bad. At random times it would be a sixth of the faults."""
    wanted = replace(GUIDED, mean_s=20.0, kinds=("coalesce", "duplicate", "pause", "reorder", "silence", "split"))
    names = [
        fault["name"]
        for seed in range(6)
        for fault in made(VirtualOptions(plant, LENGTH_S, seed=seed, random_faults=wanted))[0].faults
    ]
    assert names.count("silence") > 0.28 * len(names)


def invoke(*words: str) -> Result:
    return CliRunner().invoke(cli, words, standalone_mode=False)


@pytest.mark.long
@pytest.mark.timeout(300)
def test_shards_and_any_number_of_processes_give_the_same_runs(plant: str) -> None:
    words = ("simulate", plant, "--for", "5min", "--faults", "guided", "--fault-every", "20s", "--seeds", "1..2")
    assert invoke(*words, "--jobs", "2", "--ledger", "all.jsonl").return_value == 0
    for part in ("1/2", "2/2"):
        assert invoke(*words, "--shard", part, "--ledger", f"shard-{part[0]}.jsonl").return_value == 0
    joined = ("campaign", "merge", "shard-2.jsonl", "all.jsonl", "shard-1.jsonl", "-o", "joined.jsonl", "--json")
    [campaign] = json.loads(invoke(*joined).output)
    assert (campaign["runs"], campaign["different"]) == (2, [])
    assert len({entry.sha256 for entry in Ledger(Path("joined.jsonl")).entries}) == 2


def test_random_and_guided_faults_are_different_campaigns(plant: str) -> None:
    def what(wanted: RandomFaults) -> str:
        return what_runs(VirtualOptions(plant, 60.0, random_faults=wanted))

    assert what(GUIDED) != what(replace(GUIDED, guided=False))


@pytest.mark.long
@pytest.mark.timeout(300)
def test_a_failure_by_guided_faults_is_shrunk_to_a_scenario_that_is_confirmed(plant: str) -> None:
    done = invoke(
        *("test", "change.scenario.yaml", "--seeds", "1..2", "--faults", "guided", "--fault-every", "20s"),
        *("--for", "15min", "--fault-kinds", "silence"),
    )
    assert done.return_value == 1, done.output
    assert "confirmed: this scenario fails like the run" in done.output
    assert "fails with 1 fault of its schedule; without faults the run passes" in done.output


def test_the_programs_of_the_benchmark_run() -> None:
    bugs = Path(__file__).resolve().parents[2] / "benchmarks" / "steering_bugs" / "plant.yaml"
    run, events = made(VirtualOptions(str(bugs), 30.0, seed=1))
    assert run.summary()["ok"]
    assert {"burner.state", "dosing.state", "pumps.state", "standby.state"} <= {event.where for event in events}


def test_options_of_faults_without_chosen_faults_name_both_ways_to_choose(plant: str) -> None:
    done = invoke("simulate", plant, "--for", "1h", "--fault-every", "20s")
    assert "--faults random or --faults guided" in str(done.exception)
