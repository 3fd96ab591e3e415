"""A scenario's rules and the invariants of the system file are checked while faults chosen by each seed are active.

Defect: random faults were only available in `fieldtwin simulate`, which checks published values only. A campaign never found a
pump that runs on while its level sensor is silent (no dry-run protection).
"""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from click.testing import CliRunner

from fieldtwin.cli.run.simulate_command import command as simulate_command
from fieldtwin.cli.test.test_command import command as judge_command
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.run.campaigns.campaign import Campaign, ScenarioRuns, run_seed, verdict_of
from fieldtwin.run.campaigns.confirming import CONFIRMED
from fieldtwin.run.places.local import LocalPlace
from fieldtwin.run.places.place import run_units
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.run.virtual.fault_schedule import RandomFaults, random_schedule
from fieldtwin.scenarios.language.form import load_scenario
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.prototype.group import one_system
from fieldtwin.twin.site.system import load_system

pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]

PROFILE = """device: fieldtwin/well
source: "made for this test"
protocol: modbus
numbering: sent
tags:
  level: {at: "holding:0", poll: level}
  pump: {at: "holding:1", poll: level, access: rw}
"""
PLANT = """fieldtwin: 1
system: plant
buses:
  lan: {url: "tcp://192.0.2.1:502", timeout_ms: 200}
  line: {url: "tcp://192.0.2.2:502", timeout_ms: 200}
devices:
  sensor: {profile: well.yaml, bus: lan, unit: 1, poll: {level: {every_ms: 500}}, stale_after_ms: 2000}
  station: {profile: well.yaml, bus: line, unit: 1, poll: {level: {every_ms: 500}}, stale_after_ms: 2000, writable: [pump]}
plc:
  cycle_ms: 100
  programs:
    well: {source: well.st, inputs: {level: {tag: sensor.level}}, outputs: {pump: station.pump}}
"""
PROTOTYPE = """prototype_of: plant.yaml
buses:
  lan: {listen: "tcp://127.0.0.1:0"}
  line: {listen: "tcp://127.0.0.1:0"}
devices:
  sensor: {model: profile, values: {level: 42}}
  station: {model: profile, values: {level: 0, pump: 0}}
"""
PROGRAM = """PROGRAM Well
VAR_INPUT
  level : INT;
END_VAR
VAR_OUTPUT
  pump : INT;
END_VAR
VAR
  runs : BOOL;
END_VAR
  runs := %s;
  IF runs THEN pump := 1; ELSE pump := 0; END_IF;
END_PROGRAM
"""
RUNS_DRY = PROGRAM % "level > 10"
PROTECTED = PROGRAM % "IS_GOOD(level) AND level > 10"
RULE = """scenario: the pump never runs dry
system: plant.yaml
within:
  - {after: "quality(sensor.level) == 'bad'", then: "not well.runs", within: 1s}
steps:
  - wait: {until: "well.runs", within: 20s}
  - set: {tag: sensor.level, value: 50}
  - expect: {tag: sensor.level, value: 50, within: 2s}
"""
INVARIANTS = """invariants:
  within:
    - {after: "quality(sensor.level) == 'bad'", then: "not well.runs", within: 1s}
  never: ["well.runs and sensor.level < 5"]
"""
PLAIN = """scenario: the pump runs
system: plant.yaml
steps:
  - wait: {until: "well.runs", within: 20s}
  - expect: {tag: sensor.level, value: 42}
"""
SILENCES = RandomFaults(60.0, ("silence",), ("sensor",))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, text in (("well.yaml", PROFILE), ("plant.yaml", PLANT), ("plant.prototype.yaml", PROTOTYPE)):
        (tmp_path / name).write_text(text)
    (tmp_path / "dry.scenario.yaml").write_text(RULE)
    (tmp_path / "plain.scenario.yaml").write_text(PLAIN)
    (tmp_path / "well.st").write_text(RUNS_DRY)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def judge(*words: str) -> tuple[int, str]:
    told = CliRunner().invoke(judge_command, list(words), standalone_mode=False)
    if told.exception is not None:
        raise told.exception
    return told.return_value, told.stdout


RANDOM = ("--faults", "random", "--for", "6min", "--fault-every", "1min", "--fault-aims", "sensor")


@pytest.mark.long
def test_a_missing_dry_run_protection_is_found_and_shrunk_and_the_repaired_program_passes(folder: Path) -> None:
    code, told = judge("dry.scenario.yaml", "--seeds", "1..4", *RANDOM, "--junit", "r.xml", "--html", "r.html")
    assert code == 1
    assert "without faults the run passes" in told
    assert CONFIRMED in told
    path = min(folder.glob("dry-seed*.scenario.yaml"))
    assert path.read_text().count("fault:") == 1
    assert load_scenario(path).form.within[0].then == "not well.runs"
    failed = run_virtual(load_scenario(path))
    assert failed.verdict is Verdict.FAILED
    assert failed.reason.startswith("within 1: not well.runs within 1 s after")
    cases = ET.parse("r.xml").getroot().findall(".//testcase")
    assert cases[0].get("name") == "the pump never runs dry [4 seeds]"
    # the campaign, a seed, and the result of shrinking it
    assert sum(case.find("failure") is not None for case in cases) >= 3
    assert any(
        "silence" in (one.get("value") or "") or "fault" in (one.get("name") or "")
        for one in ET.parse("r.xml").iter("property")
    )
    assert "dry-seed" in Path("r.html").read_text()
    (folder / "well.st").write_text(PROTECTED)
    repaired = run_virtual(load_scenario(path))
    assert repaired.verdict is Verdict.PASSED, repaired.reason
    code, told = judge("dry.scenario.yaml", "--seeds", "1..4", *RANDOM)
    assert code == 0, told
    assert "4 of 4 passed" in told
    assert "took effect" in told


@pytest.mark.long
def test_an_invariant_of_the_system_file_holds_in_scenarios_campaigns_and_runs(folder: Path) -> None:
    (folder / "plant.yaml").write_text(PLANT + INVARIANTS)
    code, told = judge("plain.scenario.yaml")
    assert code == 0, told  # no fault is active: the sensor stays good
    code, told = judge("plain.scenario.yaml", "--seeds", "1..4", *RANDOM)
    assert code == 1
    assert "invariant within 1: not well.runs within 1 s after quality(sensor.level) == 'bad'" in told
    path = min(folder.glob("plain-seed*.scenario.yaml"))
    assert run_virtual(load_scenario(path)).reason.startswith("invariant within 1: ")
    faults = folder / "faults.yaml"
    faults.write_text("faults:\n  - {id: dead, name: silence, device: sensor, from: 5s, until: 20s}\n")
    words = ["plant.yaml", "--for", "100s", "--faults", str(faults), "--json"]
    summary = json.loads(CliRunner().invoke(simulate_command, words, standalone_mode=False).stdout)
    assert not summary["ok"]
    assert [one["verdict"] for one in summary["invariants"]] == ["passed", "failed"]
    assert any("invariant within 1: not well.runs" in error and "plant.yaml:" in error for error in summary["errors"])
    (folder / "well.st").write_text(PROTECTED)
    assert run_virtual(load_scenario(path)).verdict is Verdict.PASSED
    assert judge("plain.scenario.yaml", "--seeds", "1..4", *RANDOM)[0] == 0
    summary = json.loads(CliRunner().invoke(simulate_command, words, standalone_mode=False).stdout)
    assert summary["ok"], summary["errors"]
    assert [one["verdict"] for one in summary["invariants"]] == ["passed", "passed"]


def test_a_campaign_of_runs_finds_a_broken_invariant_and_confirms_its_scenario(folder: Path) -> None:
    (folder / "plant.yaml").write_text(PLANT + INVARIANTS)
    words = ["plant.yaml", "--for", "6min", "--seeds", "1..4", *RANDOM[:2], *RANDOM[4:]]
    told = CliRunner().invoke(simulate_command, words, standalone_mode=False)
    assert (told.return_value, CONFIRMED in told.output) == (1, True), told.output
    assert "invariant within 1: not well.runs" in told.output


def run_campaign(campaign: Campaign, seeds: range, jobs: int) -> list[ScenarioResult]:
    results: list[ScenarioResult] = []
    work = ScenarioRuns(campaign)
    run_units(LocalPlace(jobs), work, seeds, lambda ended: results.append(ended.result))
    return sorted(results, key=lambda result: result.seed or 0)


def test_a_seed_gives_the_same_result_whatever_the_number_of_processes(folder: Path) -> None:
    campaign = Campaign(folder / "dry.scenario.yaml", (), SILENCES, 300.0)
    one, two = (run_campaign(campaign, range(1, 4), jobs) for jobs in (1, 2))
    assert [(r.seed, r.verdict, r.trace_hash, r.faults) for r in one] == [
        (r.seed, r.verdict, r.trace_hash, r.faults) for r in two
    ]
    assert all(r.trace == () for r in two)


def test_under_random_faults_steps_only_drive(folder: Path) -> None:
    (folder / "well.st").write_text(PROTECTED)
    text = RULE.replace("value: 50, within: 2s", "value: 7, within: 2s")
    (folder / "dry.scenario.yaml").write_text(text)
    result = run_seed(Campaign(folder / "dry.scenario.yaml", (), SILENCES, 300.0), 1)
    step = next(check for check in result.checks if check.number == "3")
    assert (result.verdict, step.verdict) == (Verdict.PASSED, Verdict.SKIPPED)
    assert "not checked under random faults" in step.got
    assert judge("dry.scenario.yaml", "--seeds", "1..2")[0] == 1  # without faults they are checked


def test_a_rule_without_a_verdict_of_any_seed_and_faults_without_effect_are_inconclusive(folder: Path) -> None:
    (folder / "well.st").write_text(PROTECTED)
    campaign = Campaign(folder / "dry.scenario.yaml", (), RandomFaults(1e9), 60.0)
    whole = verdict_of(campaign, run_campaign(campaign, range(1, 3), 1), ("--seeds", "1..2"))
    assert whole.verdict is Verdict.INCONCLUSIVE
    found = {check.number: check.verdict for check in whole.checks}
    assert (found["within 1"], found["faults"], found["seeds"]) == (
        Verdict.INCONCLUSIVE,
        Verdict.INCONCLUSIVE,
        Verdict.PASSED,
    )
    assert (
        judge("dry.scenario.yaml", "--seeds", "1..2", "--faults", "random", "--for", "60s", "--fault-every", "1h")[0]
        == 1
    )


def test_rate_kinds_and_aims_are_observed(folder: Path) -> None:
    system = load_system(str(folder / "plant.yaml"), [])
    group = one_system(system, load_prototype(system))
    wanted = RandomFaults(30.0, ("silence", "exception", "stuck"), ("line", "sensor.level"))
    found = [fault for seed in range(20) for fault in random_schedule(group, seed, 1200.0, wanted)]
    assert {fault["name"] for fault in found} == {"silence", "exception", "stuck"}
    assert {(fault["device"], fault.get("register")) for fault in found if fault["device"] == "sensor"} == {
        ("sensor", "level")
    }
    assert {fault["device"] for fault in found} == {"sensor", "station"}
    assert 20 * 1080 / 30 * 0.8 < len(found) < 20 * 1080 / 30 * 1.2
    every = {fault["name"] for seed in range(200) for fault in random_schedule(group, seed, 3600.0)}
    assert not every & {"stuck", "nan", "drift", "set", "corrupt-bits"}


@pytest.mark.parametrize(
    ("wanted", "told"),
    [
        (RandomFaults(kinds=("silense",)), "did you mean 'silence'"),
        (RandomFaults(aims=("sensr",)), "did you mean 'sensor'"),
        (RandomFaults(aims=("sensor.levl",)), "did you mean 'sensor.level'"),
        (RandomFaults(kinds=("bus-off",)), "none of these faults fits"),
        (RandomFaults(kinds=("set",)), "cannot be chosen at random"),
        (RandomFaults(mean_s=0.0), "the time between two random faults"),
    ],
)
def test_an_impossible_choice_is_refused_before_anything_runs(folder: Path, wanted: RandomFaults, told: str) -> None:
    with pytest.raises(UsageError) as e:
        run_campaign(Campaign(folder / "dry.scenario.yaml", (), wanted), range(1, 3), 1)
    assert told in str(e.value)


@pytest.mark.parametrize(
    "words",
    [
        ("dry.scenario.yaml", "--faults", "random"),
        ("dry.scenario.yaml", "--jobs", "2"),
        ("dry.scenario.yaml", "--seeds", "1..2", "--fault-every", "10s"),
        ("dry.scenario.yaml", "--seeds", "1..2", "--for", "10s"),
        ("dry.scenario.yaml", "--seeds", "1..2", "--target", "local"),
        ("dry.scenario.yaml", "--seeds", "1..2", "--seed", "3"),
        ("plain.scenario.yaml", "--seeds", "1..2", "--faults", "random"),
    ],
)
def test_options_without_effect_are_refused(folder: Path, words: tuple[str, ...]) -> None:
    with pytest.raises(UsageError):
        judge(*words)


@pytest.mark.parametrize(
    ("invariants", "told"),
    [
        ('always: ["sensor.levl > 3"]', "did you mean 'sensor.level'"),
        ('always: ["3 > 2"]', "the expression refers to no value"),
        ('within: [{after: "well.runs", then: "sensor.level > 1", within: "2"}]', ""),
        ('sometimes: ["well.runs"]', "unknown key"),
    ],
)
def test_an_invariant_that_means_nothing_is_an_error_with_its_line(folder: Path, invariants: str, told: str) -> None:
    (folder / "plant.yaml").write_text(f"{PLANT}invariants:\n  {invariants}\n")
    if not told:
        assert load_scenario(folder / "plain.scenario.yaml").invariants.followed[0].limit_s == 2.0
        return
    with pytest.raises(FileInvalid) as e:
        load_scenario(folder / "plain.scenario.yaml")
    assert told in str(e.value)
    assert (e.value.path or "").endswith("plant.yaml")
    assert e.value.line == PLANT.count("\n") + 2
