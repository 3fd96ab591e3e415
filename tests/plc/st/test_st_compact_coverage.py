"""The coverage of a run as two short texts, and that of several runs together."""

from __future__ import annotations

import base64
import zlib

import pytest

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.plc.st.coverage.compact import MOST_PLACES, CompactCoverage, compact, joined_coverage
from fieldtwin.plc.st.coverage.places import Kind, Place


def places(count: int, path: str = "a.st") -> list[Place]:
    return [Place(path, n // 2 + 1, n % 2, list(Kind)[n % 3], f"THEN {n}" * (n % 3 > 0), "Pump") for n in range(count)]


def test_the_coverage_of_runs_is_joined_in_any_order_and_repetition() -> None:
    every = places(300)
    runs = [compact({place: number % 7 == own for number, place in enumerate(every)}) for own in (0, 3, 6)]
    wanted = {place: number % 7 in (0, 3, 6) for number, place in enumerate(every)}
    first = CompactCoverage(runs[1].places, runs[1].executed)
    without = [CompactCoverage("", run.executed) for run in runs]  # the places are in one entry of a ledger
    for several in (runs, runs[::-1], [*without, first], [first, *without, first, *runs]):
        assert joined_coverage(several).executed == wanted
    assert not joined_coverage(without).executed
    assert max(len(run.executed) for run in runs) < 120


def test_a_changed_program_has_its_own_places() -> None:
    old, new = places(9), places(11)
    both = joined_coverage([compact(dict.fromkeys(old, True)), compact(dict.fromkeys(new, False))])
    assert both.executed == {place: place in old for place in new}


@pytest.mark.parametrize(
    "text",
    [
        "0" * 8 + "%%%",
        "0" * 8 + base64.b64encode(b"no deflate").decode(),
        "0" * 8 + base64.b64encode(zlib.compress(bytes(10**6))).decode(),
        "0" * 8 + base64.b64encode(zlib.compress(b"12345678"))[:-8].decode(),
    ],
)
def test_a_text_that_is_no_coverage_is_refused(text: str) -> None:
    with pytest.raises(FileInvalid, match="not a coverage of programs"):
        joined_coverage([CompactCoverage("", text)])


def test_the_number_of_places_is_limited() -> None:
    compact(dict.fromkeys(places(MOST_PLACES), True))
    with pytest.raises(UsageError, match="at most 100000 statements"):
        compact(dict.fromkeys(places(MOST_PLACES + 1), True))
