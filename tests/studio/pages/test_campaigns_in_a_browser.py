"""A campaign on Studio's first page in a real Chromium: it is followed while its ledger grows."""

from __future__ import annotations

from pathlib import Path

import pytest
from studio_rig import studio

pytest.importorskip("selenium", reason="needs selenium, which is in the extra dev")
from browser import MISSING, browser

from fieldtwin.run.campaigns.ledger import Ledger, LedgerEntry

pytestmark = [pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.timeout(180)]

CAUSE = "tank: <b>the level</b> was 12 m"


def entry(seed: int, *errors: str) -> LedgerEntry:
    at_s = 1_795_890_000.0 + 2 * seed
    return LedgerEntry("w", "1", seed, 8.0, not errors, 1, 0, "ab", errors, "tank", "", at_s, 2.0, "node-1:7")


@pytest.mark.long
def test_a_campaign_is_shown_and_followed_while_its_ledger_grows(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "hours.jsonl")
    ledger.record(entry(1))
    with studio(folder=tmp_path) as running, browser() as page:
        page.go(running.page)
        page.sees(".campaigns .card", "1 run, 8 virtual hours")
        page.sees(".campaigns .chip", "passed")
        ledger.record(entry(2, CAUSE))
        page.sees(".campaigns .chip", "1 failed")
        page.sees(".campaigns .cause", f"{CAUSE} seed 2")
        assert page.elements(".campaigns a", "Report")
