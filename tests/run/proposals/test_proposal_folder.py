"""The folder of proposals: each proposal ends once, also if several users decide, and expires by itself."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec
import pytest

from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, NotAllowed, Unreachable, UsageError
from fieldtwin.run.proposals.folder import MOST_KEPT, ProposalFolder
from fieldtwin.run.proposals.judging import as_text, number_text
from fieldtwin.run.proposals.proposal import EXPIRES_AFTER_S, MOST_WAITING, Proposal, Seen

BEGIN_NS = 5_000_000_000
LIFE_NS = EXPIRES_AFTER_S * 1_000_000_000


class HandClock:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now_ns = BEGIN_NS

    def monotonic_ns(self) -> int:
        return self.now_ns

    def utc_ns(self) -> int:
        return self.now_ns

    async def sleep_until_ns(self, deadline_ns: int) -> None:
        raise AssertionError("the folder of proposals never waits")


@pytest.fixture
def clock() -> HandClock:
    return HandClock()


@pytest.fixture
def folder(tmp_path: Path, clock: HandClock) -> ProposalFolder:
    return ProposalFolder(clock, tmp_path)


@pytest.fixture
def proposal(tmp_path: Path) -> Proposal:
    return Proposal(
        number=0,
        by="agent over stdio",
        reason="",
        instance="shed",
        tag="tank.valve",
        value=1.0,
        seen=Seen(0, "good"),
        unit="",
        run_pid=1,
        run_started_ns=1,
        asked_utc_ns=BEGIN_NS,
        asked_ns=BEGIN_NS,
        expires_ns=BEGIN_NS + LIFE_NS,
        audit=str(tmp_path / "audit.jsonl"),
    )


def results(tmp_path: Path) -> list[str]:
    return [json.loads(line)["result"] for line in (tmp_path / "audit.jsonl").read_text().splitlines()]


def test_a_proposal_expires_and_cannot_be_decided_then(
    folder: ProposalFolder, proposal: Proposal, clock: HandClock, tmp_path: Path
) -> None:
    made = folder.add(proposal)
    clock.now_ns += LIFE_NS - 1
    assert folder.waiting() == [made]
    clock.now_ns += 1
    for decide in (folder.take, lambda made, by: folder.refuse(made, "refused", by)):
        with pytest.raises(NotAllowed, match="does not wait any more: expired"):
            decide(made, "user anna")
    assert folder.waiting() == []
    assert results(tmp_path) == ["expired"]


def test_a_proposal_from_before_a_restart_of_the_computer_has_expired(
    folder: ProposalFolder, proposal: Proposal, clock: HandClock
) -> None:
    made = folder.add(proposal)
    clock.now_ns = BEGIN_NS - 1
    assert folder.waiting() == []
    assert folder.state(made.number) == "expired"


def test_of_many_users_who_confirm_at_the_same_time_one_carries_the_write_out(
    folder: ProposalFolder, proposal: Proposal, tmp_path: Path
) -> None:
    made = folder.add(proposal)

    def confirm(number: int) -> bool:
        try:
            folder.take(made, f"user {number}")
        except NotAllowed:
            return False
        return True

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(confirm, range(32))) == 1
    assert results(tmp_path) == ["confirmed"]
    assert folder.state(made.number) == "confirmed, without a result yet"
    assert folder.waiting() == []


def test_numbers_are_unique_and_the_number_of_waiting_proposals_is_limited(
    folder: ProposalFolder, proposal: Proposal
) -> None:
    def add(_: int) -> int | None:
        try:
            return folder.add(proposal).number
        except UsageError:
            return None

    with ThreadPoolExecutor(4) as pool:
        numbers = [number for number in pool.map(add, range(40)) if number is not None]
    assert len(set(numbers)) == len(numbers)
    assert MOST_WAITING <= len(numbers) < MOST_WAITING + 4
    with pytest.raises(UsageError, match=f"at most {MOST_WAITING}"):
        folder.add(proposal)


def test_the_error_about_an_unknown_number_names_the_proposals_that_wait(
    folder: ProposalFolder, proposal: Proposal
) -> None:
    with pytest.raises(
        UsageError, match="proposal 3 does not wait: unknown; expected a proposal that waits, but there"
    ):
        folder.open(3)
    folder.add(proposal)
    with pytest.raises(UsageError, match=r"expected a proposal that waits: 1$"):
        folder.open(3)


def test_only_the_latest_ended_proposals_are_kept(folder: ProposalFolder, proposal: Proposal) -> None:
    for _ in range(MOST_KEPT + 5):
        folder.refuse(folder.add(proposal), "refused", "user anna")
    assert folder.state(1) == "unknown"
    assert folder.state(MOST_KEPT + 5) == "refused by user anna"
    assert folder.add(proposal).number == MOST_KEPT + 6


def test_without_an_audit_log_nothing_is_confirmed(folder: ProposalFolder, proposal: Proposal, tmp_path: Path) -> None:
    made = folder.add(msgspec.structs.replace(proposal, audit=str(tmp_path / "missing" / "audit.jsonl")))
    with pytest.raises(Unreachable, match="cannot open the audit log"):
        folder.take(made, "user anna")


def test_a_folder_that_other_users_can_enter_is_refused(
    folder: ProposalFolder, proposal: Proposal, tmp_path: Path
) -> None:
    (tmp_path / ".proposals").mkdir(mode=0o755)
    for act in (folder.waiting, lambda: folder.add(proposal)):
        with pytest.raises(Unreachable, match="other users have access"):
            act()


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"{}", b"\xff", b"9" * 100_000])
def test_a_damaged_file_is_a_typed_error(
    content: bytes, folder: ProposalFolder, proposal: Proposal, tmp_path: Path
) -> None:
    folder.add(proposal)
    (tmp_path / ".proposals" / "1.waiting.json").write_bytes(content)
    with pytest.raises(FileInvalid, match="not a proposal"):
        folder.waiting()
    with pytest.raises(FieldtwinError):
        folder.open(1)


@pytest.mark.parametrize(
    ("seen", "text"),
    [
        (Seen(0, "good"), "0"),
        (Seen(1_234_567.25, "good"), "1234567.25"),
        (Seen(3.0, "bad", "timeout"), "3 (bad, timeout)"),
        (Seen(None, "bad", "never"), "no value (bad, never)"),
        (Seen("00ff", "good"), "00ff"),
    ],
)
def test_a_value_is_shown_with_all_digits_and_its_quality(seen: Seen, text: str) -> None:
    assert as_text(seen) == text


def test_numbers_are_shown_with_all_digits() -> None:
    assert [number_text(value) for value in (1.0, -2.5, 1e15, 0.1)] == ["1", "-2.5", "1000000000000000", "0.1"]
