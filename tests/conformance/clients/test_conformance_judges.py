"""The verdict functions, tested with handwritten observations: frames and times in, a verdict out."""

from __future__ import annotations

import pytest

from fieldtwin.conformance.clients import checks as judges
from fieldtwin.conformance.clients.canopen.cases import CASES as CANOPEN_CASES
from fieldtwin.conformance.clients.canopen.checks import legal_nmt, legal_sync, takes_the_switch
from fieldtwin.conformance.clients.habits import (
    bounded_addresses,
    broadcasts_wait,
    few_connections,
    legal_requests,
    no_broadcast_reads,
)
from fieldtwin.conformance.clients.modbus.cases import CASES
from fieldtwin.conformance.core.case import CheckFunction
from fieldtwin.conformance.core.observation import (
    Ended,
    Event,
    Garbled,
    Habit,
    Left,
    Observation,
    ObservedConnection,
    ReplySent,
    RequestSeen,
    Sent,
    ValuePublished,
    Word,
)
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.results.model import Verdict

READ = bytes((17, 3, 0, 107, 0, 2))
S = NS_PER_S
START = 100 * S


def _seen(*events: Event, over_s: float = 1.0, until_s: float = 5.0, **more: object) -> Observation:
    settings: dict[str, object] = {"habit": Habit(rate_per_s=1.0), "probed": True, **more}
    return Observation(events, START, START + round(over_s * S), START + round(until_s * S), **settings)  # type: ignore[arg-type]


def _at(s: float) -> int:
    return START + round(s * S)


def _good() -> list[Event]:
    """The client asks, gets an odd answer, asks again, and publishes the second answer."""
    return [
        RequestSeen(_at(0), 1, READ),
        ReplySent(_at(0.1), 1, b"odd", False),
        RequestSeen(_at(2), 1, READ),
        ReplySent(_at(2.1), 1, b"good", True),
        ValuePublished(_at(2.2), Word.SECOND, "2222"),
    ]


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ([ValuePublished(_at(0.5), Word.POISON, "3333")], "published 3333, the value of the bad frame, 0.50 s"),
        ([ValuePublished(_at(0.5), Word.OTHER, "0")], "published 0, which no correct answer contained, 0"),
        ([Garbled(_at(3), 1, b"\xff\xff")], "2 bytes that do not form a request: ff ff"),
        ([Ended(_at(0.7), 3)], "the client ended, exit code 3, 0.70 s"),
        ([RequestSeen(_at(1 + i / 10), 1, READ) for i in range(40)], "41 requests in 5.0 s"),
        ([ObservedConnection(_at(1 + i / 10), i) for i in range(40)], "40 connections in 5.0 s"),
    ],
)
def test_forbidden_actions_of_a_client_fail(more: list[Event], says: str) -> None:
    events = sorted([*_good(), *more], key=lambda e: e.t_ns)
    finding = judges.rejects(_seen(*events))
    assert finding.verdict is Verdict.FAILED
    assert says.replace("41", str(42)) in finding.reason or says in finding.reason


def test_a_good_client_passes_and_earlier_traffic_does_not_count() -> None:
    before = ValuePublished(_at(-1), Word.POISON, "3333")
    assert judges.rejects(_seen(before, *_good())).verdict is Verdict.PASSED


def test_a_client_that_sends_nothing_afterwards_fails() -> None:
    finding = judges.survives(_seen(*_good()[:2]))
    assert finding.verdict is Verdict.FAILED
    assert "no request for 4.0 s" in finding.reason


def test_a_client_that_never_publishes_again_fails_only_if_a_probe_observes_it() -> None:
    assert "not published within 4.0 s" in judges.survives(_seen(*_good()[:4])).reason
    assert judges.survives(_seen(*_good()[:4], probed=False)).verdict is Verdict.PASSED
    assert judges.rejects(_seen(*_good()[:4], probed=False)).verdict is Verdict.SKIPPED


def test_a_correct_odd_frame_is_accepted_before_the_plain_one_arrives() -> None:
    taken = ValuePublished(_at(0.3), Word.SECOND, "2222")
    assert judges.accepts(_seen(*_good()[:2], taken, *_good()[2:])).verdict is Verdict.PASSED
    assert "were not accepted" in judges.accepts(_seen(*_good())).reason


@pytest.mark.parametrize(
    ("gap_s", "verdict"), [(0.2, Verdict.PASSED), (0.95, Verdict.INCONCLUSIVE), (0.6, Verdict.PASSED)]
)
def test_a_short_frame_is_seen_at_once(gap_s: float, verdict: Verdict) -> None:
    events = [RequestSeen(_at(0), 1, READ), ReplySent(_at(0), 1, b"x", False), RequestSeen(_at(gap_s), 1, READ)]
    habit = Habit(longest_gap_s=0.3, silent_gap_s=1.0, rate_per_s=5)
    assert judges.short_frame(_seen(*events, over_s=0, habit=habit, probed=False)).verdict is verdict


def test_a_client_that_polls_slower_than_its_timeout_gives_no_verdict_on_it() -> None:
    events = [RequestSeen(_at(0), 1, READ), ReplySent(_at(0), 1, b"x", False), RequestSeen(_at(1), 1, READ)]
    habit = Habit(longest_gap_s=1.0, silent_gap_s=1.0)
    assert judges.short_frame(_seen(*events, over_s=0, habit=habit, probed=False)).verdict is Verdict.INCONCLUSIVE


@pytest.mark.parametrize(
    ("judge", "target", "verdict"),
    [
        (legal_requests, "11 03 00 00 00 7d", Verdict.PASSED),
        (legal_requests, "11 03 00 00 00 7e", Verdict.FAILED),
        (legal_requests, "11 03 00 00 00 00", Verdict.FAILED),
        (legal_requests, "11 01 00 00 07 d1", Verdict.FAILED),
        (bounded_addresses, "11 03 ff ff 00 01", Verdict.PASSED),
        (bounded_addresses, "11 03 ff ff 00 02", Verdict.FAILED),
        (no_broadcast_reads, "00 03 00 00 00 01", Verdict.FAILED),
        (no_broadcast_reads, "00 06 00 00 00 01", Verdict.PASSED),
        (broadcasts_wait, "11 06 00 00 00 01", Verdict.SKIPPED),
    ],
)
def test_requests_against_the_standard(judge: CheckFunction, target: str, verdict: Verdict) -> None:
    assert judge(_seen(RequestSeen(_at(0), 1, bytes.fromhex(target)))).verdict is verdict


@pytest.mark.parametrize(
    ("pause_s", "verdict"), [(0.1, Verdict.PASSED), (0.09, Verdict.INCONCLUSIVE), (0.009, Verdict.FAILED)]
)
def test_units_get_time_for_a_broadcast(pause_s: float, verdict: Verdict) -> None:
    broadcast = bytes.fromhex("00 06 00 00 00 01")
    assert (
        broadcasts_wait(_seen(RequestSeen(_at(0), 1, broadcast), RequestSeen(_at(pause_s), 1, READ))).verdict is verdict
    )


def test_nmt_and_sync_against_the_standard() -> None:
    def sent(text: str) -> Observation:
        return _seen(Sent(_at(0), 1, bytes.fromhex(text)))

    assert legal_nmt(sent("0000 01 05")).verdict is Verdict.PASSED
    assert legal_nmt(sent("0000 01 80")).verdict is Verdict.FAILED
    assert legal_nmt(sent("0000 01")).verdict is Verdict.FAILED
    assert legal_sync(sent("0080 07")).verdict is Verdict.PASSED
    assert legal_sync(sent("0080 07 07")).verdict is Verdict.FAILED
    assert legal_sync(sent("0000 01 05")).verdict is Verdict.SKIPPED


@pytest.mark.parametrize("cases", [CASES, CANOPEN_CASES], ids=["modbus", "canopen"])
def test_every_case_describes_itself(cases: tuple[object, ...]) -> None:
    abouts = [case.about for case in cases]  # type: ignore[attr-defined]
    assert len({about.id for about in abouts}) == len(abouts)
    for about in abouts:
        assert all((about.title, about.clause, about.does, about.must)), about.id
        assert about.role == "client"


NOT_OF_MASTERS = {
    "MB": (*(1, 4), *range(29, 36), *range(38, 51), *(53, 57), *range(58, 64)),
    "CO": (*(3, 7), *range(9, 13), *(19, 31, 32, 41, 45, 46), *range(48, 52), *range(55, 60), *(61, 63, 64, 65, 66)),
}
"""Rows of the test-case lists without a case; docs/explanation/conformance.md gives the reasons."""


@pytest.mark.parametrize(("prefix", "rows", "cases"), [("MB", 70, CASES), ("CO", 66, CANOPEN_CASES)])
def test_every_row_of_the_list_has_a_case_or_does_not_concern_clients(
    prefix: str, rows: int, cases: tuple[object, ...]
) -> None:
    played = {int(case.about.id[3:6]) for case in cases}  # type: ignore[attr-defined]
    assert played.isdisjoint(NOT_OF_MASTERS[prefix])
    assert played | set(NOT_OF_MASTERS[prefix]) == set(range(1, rows + 1))


def test_a_client_that_gives_the_connection_up_needs_no_quarantine() -> None:
    events: list[Event] = [
        RequestSeen(_at(0), 1, READ),
        Left(_at(0.2), 1),
        ObservedConnection(_at(0.3), 2),
        *_good()[2:],
    ]
    assert judges.late_same_shape(_seen(*events)).verdict is Verdict.PASSED
    events[1] = Left(_at(0.2), 1, by_us=True)
    assert judges.late_same_shape(_seen(*events)).verdict is Verdict.INCONCLUSIVE


def test_connections_that_pile_up_are_counted() -> None:
    some = [ObservedConnection(_at(n), n) for n in range(4)]
    assert few_connections(_seen(*some)).reason == "at most 4 at once"
    assert few_connections(_seen(*some, Left(_at(5), 1), ObservedConnection(_at(5), 9))).verdict is Verdict.PASSED
    assert few_connections(_seen(*some, ObservedConnection(_at(5), 9))).verdict is Verdict.FAILED


@pytest.mark.parametrize(
    ("threshold", "word", "verdict"),
    [("00", Word.NONE, Verdict.SKIPPED), ("00", Word.POISON, Verdict.FAILED), ("15", Word.NONE, Verdict.FAILED)],
)
def test_a_client_that_forbids_the_switch_may_refuse_an_ordinary_upload(
    threshold: str, word: Word, verdict: Verdict
) -> None:
    request = bytes.fromhex(f"05 a4 00 20 00 7f {threshold} 00 00")
    events: list[Event] = [RequestSeen(_at(0.001 * n), 1, request) for n in range(1, 100)]
    found = takes_the_switch(_seen(*events, ValuePublished(_at(0.15), word, "?"), *_good()[2:]))
    assert found.verdict is verdict, found.reason
