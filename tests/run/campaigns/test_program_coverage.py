"""The coverage of Structured Text by a campaign: on one computer, in shards on a cluster, and from their ledgers."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from dask_cluster import Cluster, start_dask_threads

from fieldtwin.cli.main import cli
from fieldtwin.run.campaigns.ledger import read_entries

pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]

EXAMPLE = Path(__file__).parents[3] / "examples" / "first-bug"
RUNS = ("simulate", "tank.yaml", "--for", "30s")


@pytest.fixture(autouse=True, scope="module")
def dask_threads() -> None:
    start_dask_threads()


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(EXAMPLE, tmp_path / "site")
    monkeypatch.chdir(tmp_path / "site")
    return tmp_path / "site"


@pytest.fixture
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    made = Cluster(tmp_path_factory.mktemp("cluster"))
    yield made
    made.close()


def run(*words: str) -> Result:
    done = CliRunner().invoke(cli, words, standalone_mode=False, catch_exceptions=False)
    assert done.return_value == 0, done.output
    return done


def test_shards_on_a_cluster_have_the_coverage_of_one_computer(site: Path, cluster: Cluster) -> None:
    here = run(*RUNS, "--seeds", "1..3", "--coverage", "here.json", "--html", "here.html")
    whole = json.loads(Path("here.json").read_text())
    (program,) = whole["files"]
    assert program["path"] == "fill.st"
    assert 0 < program["statements"]["executed"] <= program["statements"]["of"]
    assert "programs  statements" in here.output
    assert "Executed Structured Text" in Path("here.html").read_text()
    cluster.add("w1", "w2")
    for shard in ("1", "2"):
        words = ("--shard", f"{shard}/2", "--ledger", f"{shard}.jsonl", "--html", "shard.html")
        run(*RUNS, "--seeds", "1..3", *words, "--on", f"dask://{cluster.address}")
    for number, ledgers in enumerate(
        (("1.jsonl", "2.jsonl"), ("2.jsonl", "1.jsonl", "2.jsonl"), ("all.jsonl", "1.jsonl"))
    ):
        run("campaign", "merge", *ledgers, "--seeds", "1..3", "-o", "all.jsonl", "--coverage", f"{number}.json")
        assert json.loads(Path(f"{number}.json").read_text()) == whole
    entries, _ = read_entries(Path("1.jsonl"))
    assert [(bool(entry.places), bool(entry.executed)) for entry in entries] == [(True, True), (False, True)]
    assert len(entries[0].executed) < 40


def test_a_ledger_of_an_older_version_has_no_coverage_and_is_merged(site: Path) -> None:
    run(*RUNS, "--seeds", "1..1", "--ledger", "old.jsonl")
    assert not {"places", "executed"} & json.loads(Path("old.jsonl").read_text()).keys()
    run(*RUNS, "--seeds", "1..2", "--ledger", "old.jsonl", "--coverage", "c.xml")
    assert 'filename="fill.st"' in Path("c.xml").read_text()
    merged = run("campaign", "merge", "old.jsonl")
    assert "coverage of Structured Text: measured in 1 of 2 runs" in merged.output
    Path("first.jsonl").write_text(Path("old.jsonl").read_text().splitlines()[0] + "\n")
    none = run("campaign", "merge", "first.jsonl", "--coverage", "none.xml")
    assert "none.xml is not written, because no run measured the coverage of Structured Text" in none.output
    assert not Path("none.xml").exists()
