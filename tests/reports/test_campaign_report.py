"""The report of a campaign and its JUnit file, from ledgers."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from click.testing import CliRunner, Result
from msgspec.structs import replace

from fieldtwin.cli.main import cli
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.reports.campaign.html import MOST_SEEDS, render_campaign
from fieldtwin.reports.campaign.workers import BINS, timeline_of, workers_of
from fieldtwin.results.model import Verdict
from fieldtwin.run.campaigns.coverage import Coverage
from fieldtwin.run.campaigns.ledger import LedgerEntry, write_entries
from fieldtwin.run.campaigns.merging import Runs
from fieldtwin.run.campaigns.reporting import campaign_of, junit_report


def entry(seed: int, *errors: str, worker: str = "node-1:7", took_s: float = 2.0) -> LedgerEntry:
    reproduce = f"fieldtwin simulate tank.yaml --for 8h --seed {seed}" if errors else ""
    at_s = 1_795_890_000.0 + 2 * seed
    return LedgerEntry(
        "w", "1", seed, 8.0, not errors, 1, 0, "ab", errors, "tank", reproduce, at_s if took_s else 0.0, took_s, worker
    )


def runs(*entries: LedgerEntry) -> Runs:
    return Runs("w", "1", entries)


def merge(*words: object) -> Result:
    return CliRunner().invoke(cli, ["campaign", "merge", *map(str, words)], standalone_mode=False)


def test_failures_with_the_same_cause_are_one_group_with_one_command() -> None:
    campaign = campaign_of(runs(entry(3, "level 12.5 m"), entry(1), entry(2, "level 13.1 m"), entry(4, "no answer")))
    assert [[run.seed for run in group.runs] for group in campaign.groups] == [[2, 3], [4]]
    assert campaign.verdict is Verdict.FAILED
    page = render_campaign([campaign])
    assert "fieldtwin simulate tank.yaml --for 8h --seed 2<" in page
    assert "--seed 3<" not in page
    assert "2 runs: seeds 2, 3" in page
    assert "causes of failures found over virtual hours" in page


def test_the_coverage_curve_counts_each_situation_once_in_the_order_of_the_ends() -> None:
    first, second, third = Coverage(frozenset({1, 2})), Coverage(frozenset({2})), Coverage(frozenset({2, 3, 9}))
    every = [replace(entry(n), coverage=c.text()) for n, c in ((3, third), (1, first), (2, second))]
    campaign = campaign_of(runs(*every))
    assert campaign.coverage == [(8.0, 2), (24.0, 4), (24.0, 4)]
    assert "4 different situations" in render_campaign([campaign])
    assert "Coverage over virtual hours" not in render_campaign([campaign_of(runs(entry(1)))])


def test_a_short_campaign_without_named_workers_has_readable_times() -> None:
    made = [replace(entry(n, worker=""), hours=0.01, coverage=Coverage(frozenset({n})).text()) for n in (1, 2)]
    page = render_campaign([campaign_of(runs(*made))])
    assert "0 workers" not in page
    assert ">36 s<" in page  # half of 0.02 h, below the curve
    assert "e-0" not in page


def test_a_missing_seed_is_inconclusive_and_is_an_error_in_junit(tmp_path: Path) -> None:
    campaign = campaign_of(runs(entry(1), entry(2)), frozenset({1, 2, 3}))
    assert campaign.verdict is Verdict.INCONCLUSIVE
    assert "seeds have no run" in render_campaign([campaign])
    cases = junit_report([campaign]).scenarios
    assert [(case.seed, case.verdict.value) for case in cases] == [(1, "passed"), (2, "passed"), (3, "inconclusive")]


def test_a_campaign_whose_faults_never_took_effect_is_not_passed() -> None:
    campaign = campaign_of(runs(entry(1)), untested=True)
    assert campaign.verdict is Verdict.INCONCLUSIVE
    assert "nothing was tested with faults" in render_campaign([campaign])
    assert junit_report([campaign]).verdict is not Verdict.PASSED


def test_of_several_results_of_a_seed_the_failure_is_shown() -> None:
    for both in ([entry(1), entry(1, "it failed")], [entry(1, "it failed"), entry(1)]):
        campaign = campaign_of(runs(*both))
        assert (len(campaign.runs), len(campaign.failed), campaign.different) == (1, 1, [1])
        assert junit_report([campaign]).scenarios[0].verdict is Verdict.FAILED


def test_a_name_from_a_ledger_cannot_become_markup() -> None:
    bad = entry(1, "<script>alert(1)</script>", worker="<b>:1")
    page = render_campaign([campaign_of(runs(bad), ledgers=["<i>.jsonl"])])
    assert "<script>" not in page
    assert "<b>:1" not in page
    assert "<i>.jsonl" not in page
    assert "&lt;script&gt;alert(1)" in page


def test_the_page_is_bounded_and_needs_no_network() -> None:
    many = [entry(seed, "it failed") for seed in range(5000)]
    page = render_campaign([campaign_of(runs(*many))])
    assert len(page) < 100_000
    assert f"and {5000 - MOST_SEEDS} more" in page
    assert "src=" not in page
    assert "<script" not in page


def test_a_ledger_of_an_older_version_has_a_report_without_times() -> None:
    page = render_campaign([campaign_of(runs(entry(1, took_s=0.0, worker="")))])
    assert "do not contain the times" in page


def test_the_timeline_counts_each_run_once_and_workers_have_their_share() -> None:
    every = [entry(seed, worker=f"node-{seed % 3}:1") for seed in range(1, 200)]
    campaign = campaign_of(runs(*every))
    timeline = timeline_of(campaign.runs)
    assert timeline is not None
    assert sum(timeline.passed) == 199
    assert len(timeline.passed) == BINS
    assert [worker.name for worker in workers_of(campaign.runs)] == ["node-0:1", "node-1:1", "node-2:1"]
    assert sum(worker.runs for worker in workers_of(campaign.runs)) == 199


def test_merged_ledgers_become_one_page_and_one_junit_file(tmp_path: Path) -> None:
    write_entries(tmp_path / "a.jsonl", [entry(1), entry(3, "it failed")])
    write_entries(tmp_path / "b.jsonl", [entry(2)])
    html, junit = tmp_path / "out" / "c.html", tmp_path / "out" / "c.xml"
    done = merge(tmp_path / "a.jsonl", tmp_path / "b.jsonl", "--seeds", "1..3", "--html", html, "--junit", junit)
    assert done.return_value == 1
    assert "a.jsonl, b.jsonl" in html.read_text()
    suite = ET.parse(junit).getroot()[0]
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("3", "1", "0")
    assert [case.get("name") for case in suite.iter("testcase")] == [f"tank [seed {n}]" for n in (1, 2, 3)]
    failure = next(suite.iter("failure"))
    assert failure.get("message") == "it failed"
    assert "reproduce: fieldtwin simulate tank.yaml --for 8h --seed 3" in (failure.text or "")


def test_no_run_in_any_ledger_is_not_a_passed_report(tmp_path: Path) -> None:
    write_entries(tmp_path / "none.jsonl", [])
    merge(tmp_path / "none.jsonl", "--html", tmp_path / "c.html", "--junit", tmp_path / "c.xml")
    assert "nothing was tested" in (tmp_path / "c.html").read_text()
    assert "inconclusive" in (tmp_path / "c.html").read_text()


def test_simulate_writes_both_reports_and_records_where_each_run_was_made(tmp_path: Path) -> None:
    ledger, html, junit = tmp_path / "l.jsonl", tmp_path / "c.html", tmp_path / "c.xml"
    words = ["simulate", "observatory", "--for", "2s", "--seeds", "1..2", "--ledger", str(ledger)]
    words += ["--html", str(html), "--junit", str(junit)]
    assert CliRunner().invoke(cli, words, standalone_mode=False).return_value == 0
    assert "Campaign of observatory" in html.read_text()
    assert ET.parse(junit).getroot()[0].get("tests") == "2"
    lines = [json.loads(text) for text in ledger.read_text().splitlines()]
    assert all(one["took_s"] > 0 and one["ended_s"] > 1e9 and ":" in one["worker"] for one in lines)
    first = html.read_text()
    assert CliRunner().invoke(cli, words, standalone_mode=False).return_value == 0  # all seeds are in the ledger
    assert html.read_text().count("virtual hours") == first.count("virtual hours")


def test_a_report_of_a_campaign_needs_seeds(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--html needs --seeds"):
        CliRunner().invoke(
            cli,
            ["simulate", "observatory", "--for", "2s", "--html", str(tmp_path / "c.html")],
            standalone_mode=False,
            catch_exceptions=False,
        )
