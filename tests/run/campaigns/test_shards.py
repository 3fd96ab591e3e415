"""Shards of a campaign, and the ledgers that they leave: no seed is lost or counted twice."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.cli.main import cli
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.run.campaigns.ledger import Ledger, LedgerEntry, write_entries
from fieldtwin.run.campaigns.many_seeds import SeedResult
from fieldtwin.run.campaigns.merging import by_fingerprint, merged
from fieldtwin.run.campaigns.seeds import parse_seeds

ENTRIES = st.builds(
    LedgerEntry,
    what=st.sampled_from(["tank", "pump"]),
    version=st.just("1"),
    seed=st.integers(0, 5),
    hours=st.just(1.0),
    ok=st.booleans(),
    checked=st.just(1),
    wrong=st.just(0),
    sha256=st.sampled_from(["aa", "bb"]),
    errors=st.sampled_from([(), ("it failed",)]),
)


@given(st.integers(0, 1000), st.integers(1, 300), st.integers(1, 40))
def test_the_shards_have_each_seed_once(first: int, count: int, shards: int) -> None:
    text = f"{first}..{first + count - 1}"
    whole = parse_seeds(text)
    parts = [parse_seeds(text, f"{n}/{shards}") for n in range(1, min(shards, count) + 1)]
    assert sorted(seed for part in parts for seed in part) == list(whole)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("shard", ["3", "/", "0/4", "5/4", "1/0", "-1/4", "a/4", "1/4/2", "1/10001", "²/4"])
def test_a_shard_of_a_wrong_form_is_an_error(shard: str) -> None:
    with pytest.raises(UsageError, match="--shard"):
        parse_seeds("1..100", shard)


def test_a_shard_without_a_seed_is_an_error() -> None:
    with pytest.raises(UsageError, match="at most 7 shards for 7 seeds"):
        parse_seeds("1..7", "8/8")


@given(st.lists(st.lists(ENTRIES, max_size=8), max_size=4), st.randoms())
def test_merging_is_commutative_and_idempotent(ledgers: list[list[LedgerEntry]], random: object) -> None:
    once = merged(ledgers)
    assert merged(reversed(ledgers)) == once
    assert merged([once, *ledgers, once]) == once
    assert merged([merged(ledgers[:1]), merged(ledgers[1:])]) == once
    assert set(once) == {entry for ledger in ledgers for entry in ledger}


def test_a_seed_with_two_results_is_reported_and_its_hours_count_once() -> None:
    one = LedgerEntry("w", "1", 7, 2.0, True, 1, 0, "aa")
    other = LedgerEntry("w", "1", 7, 2.0, True, 1, 0, "bb")
    [runs] = by_fingerprint(merged([[one], [other]]))
    assert (runs.different, runs.hours, runs.seeds) == ([7], 2.0, {7})


def test_a_run_that_two_computers_made_counts_once() -> None:
    one = LedgerEntry("w", "1", 7, 2.0, True, 1, 0, "aa", ended_s=10.0, took_s=1.0, worker="a:1")
    other = LedgerEntry("w", "1", 7, 2.0, True, 1, 0, "aa", ended_s=20.0, took_s=2.0, worker="b:1")
    assert merged([[one], [other]]) == merged([[other], [one]]) == [one]


def invoke(*words: object) -> Result:
    return CliRunner().invoke(cli, ["campaign", "merge", *map(str, words)])


def ledger(path: Path, *results: SeedResult) -> Path:
    kept = Ledger(path)
    for result in results:
        kept.add("tank", 8.0, result)
    return path


def result(seed: int, ok: bool = True, sha256: str = "ab") -> SeedResult:
    return SeedResult(seed, ok, () if ok else ("pump: the level was 12 m",), 1, 0, 1, sha256)


def test_the_ledgers_of_two_computers_become_one(tmp_path: Path) -> None:
    one = ledger(tmp_path / "1.jsonl", result(1), result(3))
    two = ledger(tmp_path / "2.jsonl", result(2), result(1))
    done = invoke(two, one, "--seeds", "1..3", "-o", tmp_path / "all.jsonl")
    assert done.exit_code in (0, None), done.output
    assert "3 from 2 ledgers" in done.output
    assert "24 h" in done.output
    assert [entry.seed for entry in Ledger(tmp_path / "all.jsonl").entries] == [1, 2, 3]
    before = (tmp_path / "all.jsonl").read_bytes()
    invoke(tmp_path / "all.jsonl", one, two, "-o", tmp_path / "all.jsonl")
    assert (tmp_path / "all.jsonl").read_bytes() == before


@pytest.mark.parametrize(
    ("entry", "seeds", "key", "value"),
    [
        (result(2, ok=False), "1..2", "failed", [2]),
        (result(1, sha256="cd"), "1", "different", [1]),
        (result(2), "1..4", "missing", [3, 4]),
    ],
)
def test_a_failed_a_different_and_a_missing_run_end_with_1(
    tmp_path: Path, entry: SeedResult, seeds: str, key: str, value: list[int]
) -> None:
    paths = [ledger(tmp_path / "1.jsonl", result(1)), ledger(tmp_path / "2.jsonl", entry)]
    done = CliRunner().invoke(
        cli, ["campaign", "merge", *map(str, paths), "--seeds", seeds, "--json"], standalone_mode=False
    )
    assert done.return_value == 1
    assert json.loads(done.output)[0][key] == value
    text = invoke(*paths, "--seeds", seeds).output
    assert {"failed": "the level was 12 m", "different": "defect", "missing": "2 (3, 4)"}[key] in text


def test_empty_ledgers_have_tested_nothing(tmp_path: Path) -> None:
    write_entries(tmp_path / "none.jsonl", [])
    done = CliRunner().invoke(cli, ["campaign", "merge", str(tmp_path / "none.jsonl")], standalone_mode=False)
    assert done.return_value == 1
    assert "nothing was tested" in done.output


def test_an_incomplete_last_line_is_not_counted_and_not_removed(tmp_path: Path) -> None:
    path = ledger(tmp_path / "1.jsonl", result(1), result(2))
    cut = path.read_bytes()[:-20]
    path.write_bytes(cut)
    done = invoke(path, "--json")
    assert json.loads(done.stdout)[0]["runs"] == 1
    assert "its last line is incomplete" in done.stderr
    assert path.read_bytes() == cut


def test_a_missing_ledger_is_named(tmp_path: Path) -> None:
    assert "none.jsonl" in str(invoke(tmp_path / "none.jsonl").exception)
