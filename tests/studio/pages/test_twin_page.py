"""The view Twin in a real Chromium: a twin that follows the plant, its decisions, and a forecast after the history."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from studio_rig import until
from twin_rig import TwinSite, twin_site

pytest.importorskip("selenium", reason="needs selenium, which is in the extra dev")
from accessibility_rules import MISSING as NO_AXE
from accessibility_rules import violations
from browser import MISSING, TABLET, WIDE, Window, browser

pytestmark = [pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.long, pytest.mark.timeout(300)]

MODEL, THREAD = "section[aria-label=Model]", "section[aria-label='Digital thread']"
ROW = "tr[data-variable='{}']"
_CUT_OFF = """
return [...document.querySelectorAll("main, main .scroll")].filter(e => e.scrollWidth > e.clientWidth).map(
  e => `${e.getAttribute("aria-label") ?? e.tagName}: ${e.scrollWidth} in ${e.clientWidth} pixels`);
"""
_WIDEST = """
const variable = document.querySelector("table.variables tbody tr").cloneNode(true);
for (const cell of [...variable.querySelectorAll("td.number")].slice(0, 2))
  cell.innerHTML = '<span class="bad-text">-1.23457e-14 (substituted)</span>';
const decision = document.querySelector("table.decisions tbody tr").cloneNode(true);
for (const cell of [...decision.querySelectorAll("td")].slice(1))
  cell.textContent = "inclinometer.slope_lateral_filtered ".repeat(3);
document.querySelector("table.variables tbody").append(variable);
document.querySelector("table.decisions tbody").append(decision);
"""
"""Append a variable and a decision with the widest texts that values, qualities and names have in practice."""


@pytest.fixture(scope="module")
def site() -> Iterator[TwinSite]:
    with tempfile.TemporaryDirectory(prefix="ftp", dir="/tmp") as root, twin_site(Path(root), follow=False) as running:
        yield running


@pytest.fixture(scope="module")
def page(site: TwinSite) -> Iterator[Window]:
    with browser() as window:
        window.go(f"{site.studio.page}#/observatory/twin")
        window.sees(".top", "live")
        yield window


def test_the_view_leads_from_the_command_line_to_the_twin_and_to_its_forecast(page: Window, site: TwinSite) -> None:
    place = site.twins()["plant_thread"]["place"]
    page.sees("main", "No shadow or twin of this instance runs on this computer")
    page.sees(".copyable", f"fieldtwin twin observatory --from {place} --command 2")

    site.start_twin()
    page.sees(MODEL, "ACTIVE, period 2 s")
    page.sees(MODEL, "states agree")
    thread = page.sees(THREAD, "connected\n")
    assert "events of the plant" in thread
    assert "written by the plant" in thread
    page.sees(ROW.format("inclinometer.serial"), "agrees")
    page.sees(ROW.format("ctd.sample"), "a message, which the gateway does not keep")
    decisions = page.sees("table.decisions", "the bytes 01 refused")
    assert "period 2 s sent\nthe model accepts it" in decisions

    page.choose("Horizon", "1 min")
    page.choose("Draw", "ctd.sample_period_s")
    page.type("input[aria-label='Commanded period in seconds']", "10")
    page.type(".what-if input[placeholder*=quality]", "quality(ctd.status) == 'good'")
    page.choose("Fault", "silence")
    page.choose("on device", "ctd")
    page.click(".what-if form button", "Ask")
    page.sees(".what-if", "command 10 s at 0 s, fault silence on ctd")
    assert "not met always quality(ctd.status) == 'good'" in page.sees(".requirements", "not met")
    page.sees(".what-if .u-legend", "ctd.sample_period_s, forecast")
    labels = page.script("return [...document.querySelectorAll('.what-if .trend')].map(e => e.ariaLabel)")
    assert any("Forecast of ctd.sample_period_s: " in label for label in labels), labels
    page.click(".what-if summary", "command line")
    page.sees(".what-if .copyable", "--from instance:observatory --horizon 60s --command 10@0s --faults faults.yaml")
    assert page.complaints() == []


def all_columns_are_in_sight(page: Window, size: tuple[int, int]) -> None:
    """Wait until no part of the page has to be scrolled sideways; a failure names the parts that have to be."""
    cut_off: list[str] = []

    def in_sight() -> bool:
        cut_off[:] = page.script(_CUT_OFF)
        return not cut_off

    try:
        until(in_sight, "")
    except AssertionError as e:
        raise AssertionError(f"cut off at {size}: {cut_off}") from e


def test_the_twin_and_its_forecast_can_be_read_on_all_screens(page: Window, site: TwinSite) -> None:
    if not site.twins()["followers"]:
        site.start_twin()
    page.sees(ROW.format("ctd.sample"), "a message, which the gateway does not keep")
    page.sees("table.decisions", "sent")
    page.script(_WIDEST)
    for size in (WIDE, TABLET):
        page.size(*size)
        all_columns_are_in_sight(page, size)
        for dark in (False, True):
            page.dark(dark)
            if not NO_AXE:
                assert violations(page) == []
