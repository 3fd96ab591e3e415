"""The page Alarms in a real Chromium: active alarms come first, and an operator acknowledges and shelves them."""

from __future__ import annotations

from pathlib import Path

import pytest
from studio_rig import OPERATE, VIEW, studio, until

pytest.importorskip("selenium", reason="needs selenium, which is in the extra dev")
from accessibility_rules import MISSING as NO_AXE
from accessibility_rules import violations
from browser import MISSING, browser

pytestmark = [pytest.mark.long, pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.timeout(180)]
EXAMPLE = Path(__file__).parents[3] / "examples" / "alarms"


def test_an_operator_acknowledges_and_shelves_alarms() -> None:
    with studio("tank.yaml", folder=EXAMPLE) as running, browser() as page:
        page.go(f"{running.url}?token={OPERATE}#/tank/alarms")
        page.sees("tbody tr:nth-child(4)", "normal")
        assert page.elements("button", "Acknowledge") == []
        with running.client() as client:
            client.put("/instances/tank/tags/sensor.level/set", json={"value": 85}).raise_for_status()
        assert "active unacknowledged" in page.sees("tbody tr:first-child", "level_high")
        page.sees(".nav a[aria-current]", "1")
        if not NO_AXE:
            assert violations(page) == []
        page.click("button", "Acknowledge")
        assert "(by studio" in page.sees("tbody tr:first-child", "active acknowledged")
        page.click("tbody tr:first-child button", "Shelve")
        page.type("dialog input", "30")
        page.click("dialog button", "Shelve")
        page.sees("tbody tr", "shelved")
        page.lacks(".nav a[aria-current]", "1")
        page.click("button", "Unshelve")
        page.sees("tbody tr:first-child", "active unacknowledged")
        assert page.complaints() == []
        page.go("about:blank")
        page.go(f"{running.url}?token={VIEW}#/tank/alarms")
        until(lambda: page.elements("tbody tr:first-child"), "the alarms are shown")
        assert page.elements("tbody button") == []
