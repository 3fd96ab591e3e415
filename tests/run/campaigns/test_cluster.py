"""Campaigns on a real Dask cluster on loopback: its workers are processes, which the tests also kill."""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Any

import msgspec
import pytest
from click.testing import CliRunner, Result
from dask_cluster import Cluster, start_dask_threads
from shed_site import write_shed
from support import eventually, run

from fieldtwin.cli.main import cli
from fieldtwin.gateway.core.errors import ConnectionLost
from fieldtwin.results.trace_about import read_about
from fieldtwin.run.campaigns.campaign import Campaign, ScenarioRuns
from fieldtwin.run.campaigns.ledger import Ledger, LedgerEntry
from fieldtwin.run.campaigns.many_seeds import SeedRuns
from fieldtwin.run.places.local import LocalPlace
from fieldtwin.run.places.place import Ended, Place, Repeats, SeedWork, run_units
from fieldtwin.run.places.sample import sample_of
from fieldtwin.run.virtual.fault_schedule import RandomFaults
from fieldtwin.run.virtual.run import VirtualOptions

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]

RULE = """scenario: the level is never high
system: shed.yaml
never: ["tank.level > 400"]
steps:
  - pause: 5s
"""
LEAKY = """import os, signal
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, ScanInfo, var_input, var_output


class Leaky(Program):
    level: float | None = var_input(TagKind.REAL)
    valve: int = var_output(TagKind.INT, initial=0)

    def execute(self, scan: ScanInfo) -> None:
        self.valve = int(os.environ["SHED"])
        if self.valve == 9:
            os.kill(os.getpid(), signal.SIGKILL)
"""
FAULTS = RandomFaults(15.0)


@pytest.fixture(autouse=True, scope="module")
def dask_threads() -> None:
    start_dask_threads()


@pytest.fixture
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    made = Cluster(tmp_path_factory.mktemp("cluster"))
    yield made
    made.close()


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_shed(tmp_path)
    (tmp_path / "level.scenario.yaml").write_text(RULE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def runs(duration_s: float = 20.0) -> SeedRuns:
    return SeedRuns(VirtualOptions("shed.yaml", duration_s, random_faults=FAULTS))


def results(
    place: Place, work: SeedWork[Any], seeds: range, heard: Callable[[Ended[int, Any]], None] = lambda ended: None
) -> tuple[dict[int, Any], Repeats[int, Any]]:
    """Return the result of each seed, after a check that each came exactly once, and the repetitions."""
    found: dict[int, Any] = {}
    repeats = Repeats(work, sample_of(seeds))

    def ended(one: Ended[int, Any]) -> None:
        assert one.unit not in found
        found[one.unit] = one.result
        heard(one)

    with place:
        run_units(place, work, seeds, ended, repeats)
    assert sorted(found) == list(seeds)
    return found, repeats


def invoke(*words: object) -> Result:
    return CliRunner().invoke(cli, [*map(str, words)], standalone_mode=False)


def test_no_seed_is_lost_or_counted_twice_while_workers_are_killed_and_added(cluster: Cluster, site: Path) -> None:
    names = [f"w{n}" for n in range(8)]
    cluster.add(*names)
    random, seeds, ledger = Random(20), range(1, 41), Ledger(site / "hours.jsonl")
    victims = dict(zip(random.sample(range(2, 25), 2), random.sample(names, 2), strict=True))
    count = 0

    def heard(ended: Ended[int, Any]) -> None:
        nonlocal count
        count += 1
        ledger.add("shed", 1.0, ended.result)
        if count in victims:
            cluster.kill(victims[count])
            cluster.add(f"instead-of-{victims[count]}")

    found, repeats = results(cluster.place(), runs(), seeds, heard)
    assert count == 40
    assert (repeats.count, repeats.different) == (1, [])
    assert sorted(entry.seed for entry in Ledger(site / "hours.jsonl").entries) == list(seeds)
    assert found == results(LocalPlace(2), runs(), seeds)[0]
    assert len({result.sha256 for result in found.values()}) > 5


def test_a_scenario_has_the_same_results_as_on_this_computer(cluster: Cluster, site: Path) -> None:
    cluster.add("w1")
    work = ScenarioRuns(Campaign(site / "level.scenario.yaml", (), FAULTS, 20.0))
    there, _ = results(cluster.place(), work, range(1, 4))
    here, _ = results(LocalPlace(1), work, range(1, 4))
    for seed in here:
        assert (there[seed].trace_hash, there[seed].verdict, there[seed].faults) == (
            here[seed].trace_hash,
            here[seed].verdict,
            here[seed].faults,
        )


def test_a_worker_with_different_software_is_refused_and_named(cluster: Cluster, site: Path, tmp_path: Path) -> None:
    changed = tmp_path / "changed" / "msgspec-0.0.1.dist-info"
    changed.mkdir(parents=True)
    (changed / "METADATA").write_text("Metadata-Version: 2.1\nName: msgspec\nVersion: 0.0.1\n")
    cluster.add("odd", environment={"PYTHONPATH": str(changed.parent)})
    done = invoke("simulate", "shed.yaml", "--for", "5s", "--seeds", "1..3", "--on", f"dask://{cluster.address}")
    assert re.search(
        "worker odd: this worker has different software.*expected msgspec .*got msgspec 0.0.1", str(done.exception)
    )


def make_leaky(site: Path) -> None:
    """Give the system a program that depends on a variable of its process's environment, which virtual time cannot exclude."""
    (site / "leaky.py").write_text(LEAKY)
    system = (site / "shed.yaml").read_text()
    changed = system.replace("source: idle.st", 'source: "python: leaky:Leaky", outputs: {valve: tank.valve}')
    (site / "shed.yaml").write_text(changed)


def test_a_seed_with_a_different_result_on_another_worker_is_a_defect(cluster: Cluster, site: Path) -> None:
    make_leaky(site)
    cluster.add("one", environment={"SHED": "0"})
    cluster.add("two", environment={"SHED": "1"})
    words = ["shed.yaml", "--for", "5s", "--seeds", "1..6", "--on", f"dask://{cluster.address}", "--ledger", "l.jsonl"]
    done = invoke("simulate", *words)
    assert done.return_value == 1, done.output
    assert re.search(r"seed \d has different results on (one and on two|two and on one); .* defect", done.output)
    merged = invoke("campaign", "merge", "l.jsonl")
    assert (merged.return_value, "different results" in merged.output) == (1, True)
    again = invoke("simulate", *words)
    assert (again.return_value, "different results" in again.output) == (1, True)


def test_a_seed_whose_processes_are_killed_is_an_error_and_runs_again_when_resumed(
    cluster: Cluster, site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_leaky(site)
    cluster.add("w1", environment={"SHED": "9"})
    words = ["simulate", "shed.yaml", "--for", "5s", "--seeds", "1..2", "--ledger", "l.jsonl"]
    done = invoke(*words, "--on", f"dask://{cluster.address}")
    assert done.return_value == 1, done.output
    assert done.stdout.count("the run did not finish: its process ended by SIGKILL, 2 times") == 2
    assert [(entry.ok, entry.sha256, entry.hours) for entry in read(site / "l.jsonl")] == [(False, "", 0.0)] * 2
    monkeypatch.setenv("SHED", "0")
    healed = invoke(*words, "--jobs", "2")
    assert healed.return_value == 0, healed.output
    assert "no run failed" in healed.output
    assert invoke("campaign", "merge", "l.jsonl", "--seeds", "1..2").return_value == 0


def test_a_campaign_of_a_scenario_is_recorded_and_resumed(cluster: Cluster, site: Path) -> None:
    cluster.add("w1")
    options = ["--faults", "random", "--for", "20s", "--fault-every", "5s", "--ledger", "l.jsonl"]
    first = invoke("test", "level.scenario.yaml", "--seeds", "1..2", *options, "--on", f"dask://{cluster.address}")
    assert first.return_value == 0, first.output
    entries = read(site / "l.jsonl")
    assert sorted((entry.seed, entry.worker, entry.verdict) for entry in entries) == [
        (1, "w1", "passed"),
        (2, "w1", "passed"),
    ]
    again = invoke("test", "level.scenario.yaml", "--seeds", "1..3", *options)
    assert again.return_value == 0, again.output
    assert "3 of 3 passed; 2 of them by the ledger" in again.output
    assert [entry.seed for entry in read(site / "l.jsonl")][2:] == [3]
    nothing_new = invoke("test", "level.scenario.yaml", "--seeds", "1..3", *options)
    assert nothing_new.return_value == 0, nothing_new.output
    assert invoke("campaign", "merge", "l.jsonl", "--seeds", "1..3").return_value == 0


def test_the_traces_of_failed_runs_reach_the_computer_of_the_user(cluster: Cluster, site: Path) -> None:
    cluster.add("w1")
    (site / "shed.yaml").write_text((site / "shed.yaml").read_text() + 'invariants: {never: ["tank.level > 10"]}\n')
    words = ["simulate", "shed.yaml", "--for", "5s", "--seeds", "1..2", "--json"]
    there = json.loads(invoke(*words, "--on", f"dask://{cluster.address}").stdout)
    assert there["traces"] == {"1": "shed-seed1.jsonl", "2": "shed-seed2.jsonl"}
    files = {path.name: path.read_bytes() for path in site.glob("shed-seed*.jsonl")}
    assert [hashlib.sha256(files[f"shed-seed{n}.jsonl"]).hexdigest() for n in (1, 2)] == [
        result["sha256"] for result in there["results"]
    ]
    about = read_about(site / "shed-seed1.jsonl")
    assert about is not None
    assert Path(about.system_path) == site / "shed.yaml"
    here = json.loads(invoke(*words).stdout)
    assert (here["traces"], {name: (site / name).read_bytes() for name in files}) == (there["traces"], files)


def read(path: Path) -> list[LedgerEntry]:
    return [msgspec.json.decode(line, type=LedgerEntry) for line in path.read_bytes().splitlines()]


def interrupted(site: Path, *options: str) -> None:
    """Send SIGINT to a campaign's process group when its ledger has an entry, and check what it says and leaves."""
    words = ["simulate", "shed.yaml", "--for", "20s", "--seeds", "1..5000", "--ledger", "l.jsonl", *options]
    campaign = subprocess.Popen(
        [sys.executable, "-m", "fieldtwin", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    ledger = site / "l.jsonl"
    run(eventually(lambda: ledger.exists() and ledger.stat().st_size > 0, within_s=120), timeout_s=130)
    os.killpg(campaign.pid, signal.SIGINT)
    said, _ = campaign.communicate(timeout=60)  # it ends when the last process with this output has ended
    assert campaign.returncode == 130, said
    count = len(read(ledger))
    assert f"interrupted: {count} of 5000 seeds have ended; with --ledger the same command continues" in said
    assert "Traceback" not in said
    assert "distributed" not in said


def test_ctrl_c_ends_a_campaign_on_a_cluster_with_what_is_known(cluster: Cluster, site: Path) -> None:
    cluster.add("w1")
    interrupted(site, "--on", f"dask://{cluster.address}")


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_ctrl_c_ends_a_local_campaign_with_what_is_known(site: Path, jobs: str) -> None:
    interrupted(site, "--jobs", jobs)


def fieldtwin(*words: str, environment: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    """Run fieldtwin as a process, in which a cluster may leave threads behind."""
    return subprocess.run(
        [sys.executable, "-m", "fieldtwin", *words],
        env=os.environ | (environment or {}),
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_a_scheduler_that_does_not_answer_is_named(site: Path) -> None:
    done = fieldtwin("simulate", "shed.yaml", "--for", "5s", "--seeds", "1..3", "--on", "dask://127.0.0.1:1")
    assert (done.returncode, done.stderr.count("\n")) == (4, 1), done.stderr
    assert "dask://127.0.0.1:1: no Dask scheduler answers" in done.stderr


def test_a_campaign_ends_when_its_scheduler_is_gone(cluster: Cluster, site: Path) -> None:
    cluster.add("w1")
    with pytest.raises(ConnectionLost, match=r"the scheduler is gone.*--ledger"):
        results(cluster.place(), runs(), range(1, 1000), lambda ended: cluster.kill("scheduler"))
