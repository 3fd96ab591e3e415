"""The search for causes on a real Dask cluster: the workers, their number and their deaths have no effect on its result."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest
from click.testing import CliRunner
from dask_cluster import Cluster, start_dask_threads
from support import eventually, run
from tank_plant import write_plant

from fieldtwin.cli.main import cli
from fieldtwin.run.campaigns.causes import Cause
from fieldtwin.run.campaigns.many_seeds import SeedResult, SeedRuns
from fieldtwin.run.campaigns.reruns import SearchStopped, Shrunk, open_search
from fieldtwin.run.campaigns.shrink import FurtherRuns
from fieldtwin.run.places.local import LocalPlace
from fieldtwin.run.places.place import Place, run_units
from fieldtwin.run.virtual.fault_schedule import RandomFaults
from fieldtwin.run.virtual.run import VirtualOptions

pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]

PLANT = """fieldtwin: 1
system: plant
buses:
  lan: {url: "tcp://192.0.2.1:502", timeout_ms: 200}
devices:
  sensor: {profile: tank.yaml, bus: lan, unit: 1, poll: {level: {every_ms: 500}}, stale_after_ms: 2000}
plc:
  cycle_ms: 100
  programs:
    pump: {source: "python: pump:Pump", inputs: {level: {tag: sensor.level}}}
"""
PUMP = """import os, signal
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, ScanInfo, var_input


class Pump(Program):
    level: int | None = var_input(TagKind.INT)
    was_bad = False
    last = losses = 0

    def execute(self, scan: ScanInfo) -> None:
        if scan.first_scan and "RAN" in os.environ:
            open(os.environ["RAN"], "w").close()
        now, bad = scan.now_ns, self.tag("level").quality.name != "GOOD"
        if bad and not self.was_bad and now > self.last + 15_000_000_000:
            self.last, self.losses = now, self.losses + 1
        self.was_bad = bad
        if self.losses == 3 and os.environ.get("PUMP", "correct") == "defect":
            raise ValueError("the level was lost three times")
        if os.path.exists(os.environ.get("KILL", "")):
            os.kill(os.getpid(), signal.SIGKILL)
"""
RULE = """scenario: the pump runs
system: plant.yaml
judge: run
steps:
  - pause: 5s
"""
FAULTS = ("--for", "6min", "--faults", "random", "--fault-kinds", "silence,reset", "--fault-every", "20s")
DEFECT = {"PUMP": "defect"}
RUNS = SeedRuns(VirtualOptions("plant.yaml", 360.0, random_faults=RandomFaults(20.0, ("silence", "reset"))))
GUIDED = SeedRuns(
    VirtualOptions("plant.yaml", 360.0, random_faults=RandomFaults(20.0, ("silence", "reset"), guided=True))
)


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of a plant whose program fails when it has lost its level three times, if the environment variable
    PUMP is `defect`.
    """
    write_plant(tmp_path, PLANT)
    (tmp_path / "pump.py").write_text(PUMP)
    (tmp_path / "pump.scenario.yaml").write_text(RULE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(autouse=True, scope="module")
def dask_threads() -> None:
    start_dask_threads()


@pytest.fixture
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    made = Cluster(tmp_path_factory.mktemp("cluster"))
    yield made
    made.close()


@dataclass(frozen=True, slots=True)
class WatchedRuns(SeedRuns):
    """Runs that call `heard` on this computer for each result. The workers of a cluster get the runs without it."""

    heard: Callable[[], None] = print

    def errors_of(self, result: SeedResult) -> Sequence[str]:
        self.heard()
        return SeedRuns.errors_of(self, result)


def failed_runs(work: SeedRuns = RUNS) -> dict[int, SeedResult]:
    failed: dict[int, SeedResult] = {}
    run_units(LocalPlace(2), work, [1, 2, 3], lambda one: failed.update({one.unit: one.result}))
    return {seed: result for seed, result in sorted(failed.items()) if not result.ok}


def found_causes(
    place: Place, work: SeedRuns, failed: dict[int, SeedResult]
) -> tuple[list[Cause[int, Shrunk[SeedResult]]], int]:
    """Return the causes, and the number of further runs that are left."""
    further = FurtherRuns(0)
    with place, open_search(place, work, further) as search:
        return list(search.causes(failed)), further.left


def test_killed_and_added_workers_change_neither_the_causes_nor_the_count_of_runs(
    cluster: Cluster, site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PUMP", "defect")
    failed = failed_runs()
    here, left_here = found_causes(LocalPlace(1), RUNS, failed)
    assert (len(failed), max(len(cause.small.faults) for cause in here)) == (3, 3)
    cluster.add("w1", "w2", "w3")
    count, kills = 0, {4: "w1", 8: "w2", 12: "w3"}

    def heard() -> None:
        nonlocal count
        count += 1
        if count in kills:
            cluster.add(f"instead-of-{kills[count]}")
            cluster.kill(kills[count])

    assert found_causes(cluster.place(), WatchedRuns(RUNS.options, heard=heard), failed) == (here, left_here)
    assert count > max(kills)


def test_guided_faults_are_found_again_on_the_workers_and_not_on_this_computer(
    cluster: Cluster, site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PUMP", "defect")
    failed = failed_runs(GUIDED)
    here, left_here = found_causes(LocalPlace(1), GUIDED, failed)
    assert here[0].small.faults
    cluster.add("w1", "w2", "w3")
    monkeypatch.setenv("RAN", str(site / "ran"))  # not in the environment of the workers
    count = 0

    def heard() -> None:
        nonlocal count
        count += 1
        if count == len(failed):  # the next unit finds the faults of the first seed
            cluster.kill("w1")

    assert found_causes(cluster.place(), WatchedRuns(GUIDED.options, heard=heard), failed) == (here, left_here)
    assert count > len(failed)
    assert not (site / "ran").exists()
    GUIDED.faults_of(1)
    assert (site / "ran").exists()  # such a run on this computer would have been seen


def invoke(*words: str) -> str:
    done = CliRunner().invoke(cli, [*words, *FAULTS, "--seeds", "1..2"], standalone_mode=False)
    assert done.return_value == 1, done.output
    return done.stdout


def scenarios(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*-seed*.scenario.yaml")}


def test_the_causes_are_found_on_the_workers_and_equal_those_of_this_computer(
    cluster: Cluster, site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cluster.add("w1", "w2", environment=DEFECT)
    on = ("--on", f"dask://{cluster.address}")
    there = json.loads(invoke("simulate", "plant.yaml", "--json", *on))  # the defect exists on the workers only
    judged = invoke("test", "pump.scenario.yaml", *on)
    written = scenarios(site)
    assert sorted(written) == ["plant-seed1.scenario.yaml", "pump-seed1.scenario.yaml"]
    assert "cause  reset on sensor, silence on sensor: 2 failed seeds (1, 2)" in judged
    assert "not confirmed: this scenario has a different result" in judged
    monkeypatch.setenv("PUMP", "defect")
    here = json.loads(invoke("simulate", "plant.yaml", "--json"))
    invoke("test", "pump.scenario.yaml")
    assert (there["groups"], there["results"]) == (here["groups"], here["results"])
    assert scenarios(site) == written


def test_a_run_that_does_not_finish_stops_the_search_and_is_not_counted_as_passed(
    site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PUMP", "defect")
    failed = failed_runs()
    monkeypatch.setenv("KILL", str(site / "plant.yaml"))
    with pytest.raises(SearchStopped, match=r"the run of seed 1 with a part of its faults did not finish: .* SIGKILL"):
        found_causes(LocalPlace(1), RUNS, failed)


def searching(site: Path, cluster: Cluster, then: Callable[[subprocess.Popen[str]], None]) -> tuple[int, str]:
    """Run a campaign on the cluster, call `then` when it searches the causes, and return its exit code and output."""
    words = ["simulate", "plant.yaml", *FAULTS, "--seeds", "1..2", "--on", f"dask://{cluster.address}"]
    campaign = subprocess.Popen(
        [sys.executable, "-m", "fieldtwin", *words],
        cwd=site,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    assert campaign.stdout is not None
    said = ""
    while "searching the causes of 2 failed seeds" not in said:
        said += (line := campaign.stdout.readline())
        assert line, said
    then(campaign)
    rest, _ = campaign.communicate(timeout=200)
    assert "Traceback" not in rest, rest
    return campaign.returncode, rest


def test_ctrl_c_during_the_search_ends_the_campaign_and_its_processes_on_the_workers(
    cluster: Cluster, site: Path
) -> None:
    cluster.add("w1", environment=DEFECT)
    worker = psutil.Process(cluster.pid("w1"))

    def interrupt(campaign: subprocess.Popen[str]) -> None:
        run(eventually(lambda: bool(worker.children()), within_s=60), timeout_s=70)
        os.killpg(campaign.pid, signal.SIGINT)

    code, said = searching(site, cluster, interrupt)
    assert (code, "interrupted: the search for causes has not ended" in said) == (130, True), said
    assert "seeds         2, 2 failed" in said
    run(eventually(lambda: not worker.children(), within_s=60), timeout_s=70)


def test_a_scheduler_that_ends_during_the_search_leaves_the_results_of_the_campaign(
    cluster: Cluster, site: Path
) -> None:
    cluster.add("w1", environment=DEFECT)
    code, said = searching(site, cluster, lambda campaign: cluster.kill("scheduler"))
    assert (code, "seeds         2, 2 failed" in said) == (1, True), said
    assert "the search for causes stopped, and these have no cause: 2 failed seeds (1, 2): " in said
    assert "the scheduler is gone" in said
    assert "no trace of seed 1: " in said
