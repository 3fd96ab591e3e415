"""Coverage of a run: a set that joins in any order, is short as text, and tells situations apart that differ."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from tank_plant import write_plant

from fieldtwin.cli.main import cli
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.results.trace import Trace, TraceKind
from fieldtwin.run.campaigns.coverage import MAX_NUMBER, MAX_TEXT, MOST_OF_KIND, Coverage, Kind, element, joined
from fieldtwin.run.campaigns.coverage_collector import MOST_VALUES, MOST_VARIABLES, CoverageCollector
from fieldtwin.run.campaigns.ledger import LedgerEntry, read_entries
from fieldtwin.run.campaigns.merging import by_fingerprint, merged

SETS = st.frozensets(st.integers(0, MAX_NUMBER), max_size=60).map(Coverage)
PROGRAM = """PROGRAM Pump
VAR_INPUT
  level : INT;
END_VAR
VAR
  valid : BOOL;
END_VAR
  valid := IS_GOOD(level);
END_PROGRAM
"""
OLD_LINE = (
    b'{"what":"w","version":"0.1.0","seed":1,"hours":1.0,"ok":true,"checked":9,"wrong":0,"sha256":"aa","errors":[]}\n'
)


@given(SETS)
def test_a_coverage_is_the_same_after_its_text_is_read(coverage: Coverage) -> None:
    assert Coverage.parse(coverage.text()) == coverage


@given(st.lists(SETS, max_size=5), st.randoms())
def test_joining_depends_on_neither_order_nor_repetition(sets: list[Coverage], random: object) -> None:
    texts = [one.text() for one in sets]
    again = [*reversed(texts), *texts]
    assert joined(texts) == joined(again)
    assert joined(texts).elements == frozenset().union(*(one.elements for one in sets))


@given(st.text(max_size=60))
def test_any_text_is_a_coverage_or_a_typed_error(text: str) -> None:
    try:
        coverage = Coverage.parse(text)
    except FileInvalid:
        return
    assert all(0 <= one <= MAX_NUMBER for one in coverage.elements)


@pytest.mark.parametrize("text", ["!", "gA==", "gICAAA==", "////fw==", "A" * (MAX_TEXT + 4)])
def test_a_damaged_text_is_an_error(text: str) -> None:
    with pytest.raises(FileInvalid, match="not a coverage"):
        Coverage.parse(text)


def test_an_element_has_the_same_number_on_every_computer() -> None:
    assert element(Kind.STATE, "relay.state", "STANDBY", "") == 12179


def collected(*events: tuple[float, TraceKind, str, dict[str, object]]) -> Coverage:
    trace, collector = Trace(), CoverageCollector()
    collector.listen(trace)
    for at_s, kind, where, data in events:
        trace.note(round(at_s * NS_PER_S), kind, where, data)
    return collector.coverage


def state(at_s: float, value: object, where: str = "pump.state") -> tuple[float, TraceKind, str, dict[str, object]]:
    return at_s, TraceKind.STATE, where, {"value": value}


def fault(at_s: float, begin_s: float, until_s: float) -> tuple[float, TraceKind, str, dict[str, object]]:
    said = {"from": begin_s, "until": until_s}
    return at_s, TraceKind.FAULT, "f1", {"name": "silence", "on": True, "target": "sensor", "said": said}


def tag(at_s: float, quality: str) -> tuple[float, TraceKind, str, dict[str, object]]:
    return at_s, TraceKind.TAG, "sensor.level", {"value": 1, "quality": quality, "reason": "none"}


def test_a_fault_counts_from_its_begin_to_its_end() -> None:
    during = element(Kind.STATE, "pump.state", "FILL", "silence sensor")
    without = element(Kind.STATE, "pump.state", "FILL", "")
    injected = fault(0, 10, 20)
    for at_s, number in ((5, without), (15, during), (25, without)):
        assert number in collected(injected, state(1, "IDLE"), state(at_s, "FILL")).elements
    assert during not in collected(injected, state(1, "IDLE"), state(25, "FILL")).elements


def test_times_of_a_fault_that_is_injected_during_the_run_count_from_the_start_of_the_run() -> None:
    """Defect: they counted from the injection, but the benches inject a fault with times that count from the start."""
    during = element(Kind.STATE, "pump.state", "FILL", "silence sensor")
    for at_s, active in ((105, False), (115, True), (125, False)):
        found = collected(fault(100, 110, 120), state(at_s, "FILL"))
        assert (during in found.elements) == active
    assert during in collected(fault(100, 10, 120), state(101, "FILL")).elements
    assert during not in collected(fault(100, 10, 20), state(101, "FILL")).elements


def test_a_fault_soon_after_a_transition_differs_from_a_later_one() -> None:
    soon = collected(state(1, "FILL"), fault(1, 0.05, 5), state(9, "IDLE"))
    later = collected(state(1, "FILL"), fault(1, 50, 55), state(90, "IDLE"))
    assert soon.counts()["begin"] == later.counts()["begin"] == 2
    assert (soon - later).counts()["begin"] > 0


def test_each_transition_is_distinguished() -> None:
    forth = collected(state(1, "IDLE"), state(2, "FILL"))
    both = collected(state(1, "IDLE"), state(2, "FILL"), state(3, "IDLE"), state(4, "FILL"))
    assert (forth.counts()["transition"], both.counts()["transition"]) == (1, 2)


def test_a_bad_tag_is_seen_in_each_state_and_again_when_it_is_good() -> None:
    bad = collected(state(1, "IDLE"), tag(2, "bad"), tag(3, "bad"), state(4, "FILL"))
    assert bad.counts()["tag"] == 3
    assert collected(state(1, "IDLE"), tag(2, "bad"), tag(5, "good"), tag(6, "good")).counts()["tag"] == 4
    assert collected(state(1, "IDLE"), tag(2, "good")).counts()["tag"] == 0


def test_measured_values_are_not_states() -> None:
    assert not collected(state(1, 4.5), state(2, 4711), state(3, None))


def test_variables_and_values_are_limited() -> None:
    many = [state(n, f"S{n}") for n in range(3 * MOST_VALUES)]
    assert collected(*many).counts()["state"] == MOST_VALUES
    more = [state(n, True, f"pump.v{n}") for n in range(3 * MOST_VARIABLES)]
    assert collected(*more).counts()["state"] == MOST_VARIABLES


def test_a_run_of_unlimited_situations_adds_a_limited_number() -> None:
    events = [state(0, "IDLE")]
    for n in range(2 * MOST_OF_KIND):
        events.append((1.0, TraceKind.TAG, f"sensor.t{n}", {"value": 1, "quality": "bad", "reason": "none"}))
    assert collected(*events).counts()["tag"] <= MOST_OF_KIND


def test_a_ledger_of_an_older_version_has_no_coverage(tmp_path: Path) -> None:
    path = tmp_path / "old.jsonl"
    path.write_bytes(OLD_LINE)
    (entry,), _ = read_entries(path)
    assert entry.coverage == ""
    (runs,) = by_fingerprint([entry])
    assert len(runs.coverage) == 0


def test_of_the_same_run_with_and_without_coverage_the_coverage_stays() -> None:
    old = msgspec.json.decode(OLD_LINE, type=LedgerEntry)
    new = msgspec.structs.replace(old, coverage=Coverage(frozenset({7})).text())
    assert merged([[old], [new]]) == merged([[new], [old]]) == [new]


@pytest.mark.long
def test_a_campaign_records_its_coverage_and_merge_shows_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_plant(tmp_path)
    (tmp_path / "pump.st").write_text(PROGRAM)
    monkeypatch.chdir(tmp_path)
    words = "simulate plant.yaml --for 5min --faults random --fault-every 20s --seeds 1..3 --ledger hours.jsonl --json"
    told = json.loads(CliRunner().invoke(cli, words.split()).stdout)
    assert told["coverage"]["tag"] > 0
    again = json.loads(CliRunner().invoke(cli, words.replace(" --ledger hours.jsonl", "").split()).stdout)
    assert again["coverage"] == told["coverage"]
    (whole,) = json.loads(CliRunner().invoke(cli, ["campaign", "merge", "hours.jsonl", "--json"]).stdout)
    assert whole["coverage"] == told["coverage"]
