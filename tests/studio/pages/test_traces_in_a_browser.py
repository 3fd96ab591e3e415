"""A failing scenario's trace in a real Chromium: to the failed check, its bad value and frames, and through time by keyboard."""

from __future__ import annotations

from pathlib import Path

import pytest
from studio_rig import Studio, studio, until
from trace_rig import FAILED_NS, FAULT_NS, TITLE, failing_trace

pytest.importorskip("selenium", reason="needs selenium, which is in the extra dev")
from accessibility_rules import MISSING as NO_AXE
from accessibility_rules import violations
from browser import MISSING, Window, browser
from selenium.webdriver.common.keys import Keys

pytestmark = [pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.timeout(180)]

PRESSURE = "tr[data-tag='ctd.pressure']"


def shown_s(page: Window) -> float:
    """Return the instant that the slider states, in seconds."""
    return float(page.script("return document.querySelector('.knob')?.getAttribute('aria-valuenow')") or "nan")


def at(page: Window, t_ns: int) -> None:
    until(lambda: abs(shown_s(page) * 1e9 - t_ns) < 1, f"the slider is at {t_ns} ns")


def test_the_failed_check_of_a_trace_is_found_and_the_run_is_walked_through_by_keyboard(tmp_path: Path) -> None:
    failing_trace(tmp_path, "--html", "report.html")
    with studio("fail.jsonl", "--at", "0.1s", folder=tmp_path) as running, browser() as page:
        opened(page, running)
        at(page, 100_000_000)
        page.sees(".top", TITLE)
        page.sees(".top", "recorded, read-only")
        page.click(".nav a", "Devices")
        page.sees(PRESSURE, "never read")

        banner = page.sees(".banner[role=status]", "Failed: step 5")
        assert "expected ctd.pressure good" in banner
        assert "got bad (timeout)" in banner
        page.click(".banner button", "Show")
        at(page, FAILED_NS)
        page.sees(PRESSURE, "bad: timeout")
        page.sees(".banners", "silence on ctd")
        assert not page.elements("button", "Set …")

        page.click(".nav a", "Bus")
        page.sees(".frames .item", "0:06.503")
        page.choose("Device", "ctd")
        page.sees(".frames .item", "no reply")

        press(page, Keys.PAGE_UP)
        at(page, FAULT_NS)
        page.click(".nav a", "Devices")
        page.sees(PRESSURE, "good")
        press(page, Keys.HOME)
        at(page, 0)
        page.sees(PRESSURE, "never read")
        press(page, Keys.END)
        at(page, FAILED_NS + 1)
        page.sees("tr[data-tag='inclinometer.slope_long']", "bad: unreachable")
        press(page, Keys.PAGE_UP)
        at(page, FAILED_NS)
        page.sees("tr[data-tag='inclinometer.slope_long']", "good")

        page.click(".mark.state")
        at(page, 350_000_000)
        page.click(".nav a", "PLC")
        page.sees(".now-state", "ACTIVE")
        press(page, Keys.ARROW_LEFT)
        page.sees(".now-state", "STANDBY")
        page.click(".nav a", "Trends")
        page.sees(".trend", "ctd.pressure")

        page.go(page.script("return [...document.querySelectorAll('.top a')].find((a) => a.text === 'Report').href"))
        page.sees("h2", "Verdicts")
        page.click("a", "Show the trace at this instant")
        at(page, FAILED_NS)
        assert page.complaints() == []


@pytest.mark.long
@pytest.mark.skipif(bool(NO_AXE), reason=NO_AXE)
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_no_view_of_a_trace_violates_a_rule_of_wcag_2_a_or_aa(tmp_path: Path, dark: bool) -> None:
    failing_trace(tmp_path)
    with studio("fail.jsonl", folder=tmp_path) as running, browser() as page:
        page.dark(dark)
        opened(page, running)
        at(page, FAILED_NS)
        found = {}
        for view in ("Overview", "Devices", "Bus", "PLC", "Trends"):
            page.click(".nav a", view)
            page.sees(".nav a[aria-current]", view)
            until(lambda: page.elements("main > :not(h1)"), f"{view} is drawn")
            found[view] = violations(page)
        assert {view: broken for view, broken in found.items() if broken} == {}


def press(page: Window, key: str) -> None:
    """Press a key on the slider."""
    page.script("document.querySelector('.knob').focus()")
    page.press(key)


def opened(page: Window, running: Studio) -> None:
    """Open the address that the command has printed."""
    line = running.log.read_text(encoding="utf-8").splitlines()[0]
    page.go(line.partition("  →  ")[2])
