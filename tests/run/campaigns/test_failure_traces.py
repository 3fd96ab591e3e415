"""A campaign keeps the traces of failed runs as files, within limits, and states how to repeat the runs without a trace."""

from __future__ import annotations

import hashlib
import json
import zlib
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from shed_site import write_shed

from fieldtwin.cli.main import cli
from fieldtwin.results.trace import read_trace
from fieldtwin.results.trace_about import read_about
from fieldtwin.run.campaigns import failure_traces
from fieldtwin.run.campaigns.failure_traces import (
    MOST_TRACES,
    NOT_REPRODUCED,
    TOO_LARGE,
    TOO_MANY_BYTES,
    KeptTraces,
    PackedTrace,
    TraceRuns,
    choose,
)
from fieldtwin.run.campaigns.many_seeds import SeedRuns
from fieldtwin.run.virtual.run import VirtualOptions

pytestmark = pytest.mark.timeout(300)
TOO_HIGH = 'invariants: {never: ["tank.level > 10"]}\n'
RULE = """scenario: the level is low
system: shed.yaml
never: ["tank.level > 10"]
steps:
  - pause: 5s
"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of a system in which each run fails."""
    write_shed(tmp_path)
    (tmp_path / "shed.yaml").write_text((tmp_path / "shed.yaml").read_text() + TOO_HIGH)
    (tmp_path / "low.scenario.yaml").write_text(RULE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def invoke(*words: object) -> Result:
    return CliRunner().invoke(cli, [*map(str, words)], standalone_mode=False)


@pytest.mark.long
@pytest.mark.parametrize("jobs", ["1", "2"])
def test_each_failed_run_of_a_system_leaves_its_trace(site: Path, jobs: str) -> None:
    words = ["simulate", "shed.yaml", "--for", "5s", "--seeds", "3..4", "--jobs", jobs]
    found = json.loads(invoke(*words, "--json", "--html", "c.html").stdout)
    assert found["traces"] == {"3": "shed-seed3.jsonl", "4": "shed-seed4.jsonl"}
    for result in found["results"]:
        trace = site / found["traces"][str(result["seed"])]
        assert hashlib.sha256(trace.read_bytes()).hexdigest() == result["sha256"]
        about = read_about(trace)
        assert about is not None
        assert (about.seed, Path(about.system_path), about.verdict) == (result["seed"], site / "shed.yaml", "failed")
    assert "shed-seed4.jsonl" in (site / "c.html").read_text()
    assert "trace of seed 3: shed-seed3.jsonl" in invoke(*words).stdout


@pytest.mark.long
def test_each_failed_run_of_a_scenario_leaves_its_trace(site: Path) -> None:
    words = ["test", "low.scenario.yaml", "--seeds", "1..2"]
    found = json.loads(invoke(*words, "--json", "--html", "c.html").stdout)
    page = (site / "c.html").read_text()
    assert "<h1>Campaign of low</h1>" in page
    assert "low-seed2.jsonl" in page
    assert "different situations" in page
    assert found[0]["coverage"] == found[1]["coverage"] == found[2]["coverage"]
    assert sum(found[0]["coverage"].values()) > 0
    assert [one["trace_file"] for one in found] == ["", "low-seed1.jsonl", "low-seed2.jsonl"]
    assert read_trace((site / "low-seed2.jsonl").read_bytes().splitlines())
    said = invoke(*words).stdout
    assert "trace of seed 2: low-seed2.jsonl" in said
    assert f"coverage: {sum(found[0]['coverage'].values())} different situations" in said


@pytest.mark.long
def test_seeds_beyond_the_limit_are_named_with_the_command_that_repeats_the_first(
    site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["simulate", "shed.yaml", "--for", "5s", "--seeds", f"1..{MOST_TRACES + 2}"]
    monkeypatch.setattr("sys.argv", ["fieldtwin", *words])
    said = invoke(*words).stdout
    assert len(list(site.glob("shed-seed*.jsonl"))) == MOST_TRACES
    assert (
        "no trace of 2 failed seeds (9, 10): a campaign keeps at most 8 traces; repeat the run of seed 9 with: "
        "fieldtwin simulate shed.yaml --for 5s --seed 9"
    ) in said


def test_a_campaign_in_which_every_run_passes_leaves_no_trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_shed(tmp_path)
    monkeypatch.chdir(tmp_path)
    found = json.loads(invoke("simulate", "shed.yaml", "--for", "5s", "--seeds", "1..2", "--json").stdout)
    assert (found["traces"], list(tmp_path.glob("*.jsonl"))) == ({}, [])


def test_a_trace_that_is_too_large_stays_where_it_was_made(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work = TraceRuns(SeedRuns(VirtualOptions("shed.yaml", 20.0)))
    assert zlib.decompress(work.run(1).packed)
    monkeypatch.setattr(failure_traces, "MAX_TRACE_BYTES", 4096)
    assert work.run(1) == PackedTrace(reason=TOO_LARGE)
    monkeypatch.undo()
    monkeypatch.chdir(site)
    monkeypatch.setattr(failure_traces, "MAX_PACKED_BYTES", 100)
    assert work.run(1) == PackedTrace(reason=TOO_LARGE)


def test_a_trace_that_cannot_be_kept_has_a_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(failure_traces, "MAX_TOTAL_BYTES", 9)
    kept = KeptTraces()
    for seed, text in enumerate([b"12345", b"67890", b"1234"], 1):
        kept.keep(seed, "hash", PackedTrace("hash", zlib.compress(text)), tmp_path / f"{seed}.jsonl")
    kept.keep(4, "hash", PackedTrace("different hash", zlib.compress(b"")), tmp_path / "4.jsonl")
    kept.keep(5, "hash", PackedTrace("hash", zlib.compress(b"")), tmp_path / "no such folder" / "5.jsonl")
    kept.keep(6, "hash", TraceRuns(SeedRuns(VirtualOptions("", 1.0))).unfinished(6, "too slow"), tmp_path / "6.jsonl")
    assert (list(kept.files), kept.bytes) == ([1, 3], 9)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.jsonl", "3.jsonl"]
    assert (kept.missing[2], kept.missing[4]) == (TOO_MANY_BYTES, NOT_REPRODUCED)
    assert "No such file or directory" in kept.missing[5]
    assert kept.missing[6] == "its run for the trace did not finish: too slow"


def test_the_first_seed_of_each_cause_has_a_trace_before_the_other_failed_seeds() -> None:
    assert choose(range(1, 21), [7, 12]) == [7, 12, 1, 2, 3, 4, 5, 6]
    assert choose([5], []) == [5]
