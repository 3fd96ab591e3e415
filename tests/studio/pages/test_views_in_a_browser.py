"""The parts of the views that a user operates, one flow for each, in a real Chromium: details of a frame, state diagram, write
dialog, trends with cursors and zoom, and the timeline of a scenario."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator

import pytest
from msgspec import structs
from studio_rig import OPERATE, Studio, until

from fieldtwin.run.processes.run_record import SYSTEM_FILE, read_record, write_record

pytest.importorskip("selenium", reason="needs selenium, which is in the extra dev")
from browser import MISSING, WIDE, Window, browser
from selenium.webdriver.common.action_chains import ActionChains

pytestmark = [pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.timeout(180)]

ROW = "tr[data-tag='{}']"


@pytest.fixture(scope="module")
def chromium(observatory: Studio) -> Iterator[Window]:
    with browser() as window:
        window.go(f"{observatory.url}?token={OPERATE}")
        yield window


@pytest.fixture
def page(chromium: Window, observatory: Studio) -> Iterator[Window]:
    chromium.go(f"{observatory.url}#/observatory/overview")
    chromium.sees(".top", "live")
    chromium.complaints()
    yield chromium
    with observatory.client() as client:
        client.delete("/instances/observatory/faults")
        client.delete("/instances/observatory/plc/forces")
    assert chromium.complaints() == []


def test_no_width_of_the_window_cuts_the_function_of_a_frame(page: Window) -> None:
    """At 800 pixels, Function and Meaning both showed the first letters of "read holding registers"."""
    page.click(".nav a", "Bus")
    page.sees(".frames .item", "read holding registers")
    page.click("button", "Pause")
    cut = """
    const rows = [...document.querySelectorAll('.frames .row')].map((row) => row.children[arguments[0]]);
    return rows.filter((cell) => cell && cell.scrollWidth > cell.clientWidth).length"""
    try:
        for width, shows_function in ((800, False), (1000, False), (1100, True), (1280, True), (1920, True)):
            page.size(width, 900)
            until(lambda shown=shows_function: ("Function" in page.text(".frames .head")) == shown, f"{width} px")
            assert page.script(cut, 4) == 0, width
            wide = page.script("return document.querySelector('.frames .item').children[5].clientWidth")
            assert wide >= 195, width  # the meaning
    finally:
        page.size(*WIDE)


def test_a_frame_is_explained_field_by_field_and_leads_to_its_reply(page: Window) -> None:
    page.click(".nav a", "Bus")
    page.choose("Device", "ctd")
    page.choose("Function", "read input registers")
    page.sees(".frames .item", "good")
    page.click("button", "Pause")
    page.click(".frames .item", "good")
    heading = page.sees(".detail h2", "Frame ")
    page.sees(".detail table.list", "unit ID")
    page.click(".detail tbody tr")
    page.press("\ue015")  # arrow down
    until(
        lambda: page.script("return document.activeElement === document.querySelectorAll('.detail tbody tr')[1]"),
        "the next field has the focus",
    )
    until(lambda: len(page.elements(".detail .bytes .field.marked")) == 1, "its bytes are marked")
    page.click(".detail .facts button", "frame ")
    until(lambda: page.text(".detail h2") not in ("", heading), "the reply is shown")
    page.click(".detail button", "Close")
    until(lambda: not page.elements(".detail"), "the details are closed")


def test_the_state_diagram_shows_the_present_state_and_a_forced_one_by_its_word(page: Window) -> None:
    page.click(".nav a", "PLC")
    page.sees(".states .state.now", "STANDBY")
    page.click(f"{ROW.format('relay.state')} button", "Force")
    page.script(
        "const s = document.querySelector('dialog select'); s.value = '1'; s.dispatchEvent(new Event('change', {bubbles: true}))"
    )
    word = page.script("return document.querySelector('dialog select').selectedOptions[0].textContent.split(' ')[0]")
    page.click("dialog footer button", "Force")
    page.sees(".states .state.now", word)
    page.sees(".banner", f"relay.state = {word}")
    page.sees(".transitions", word)
    page.click(".banner button", "Remove all forces")
    page.lacks(".banners", "relay.state")


def test_the_write_dialog_shows_both_values_and_the_reason_of_a_refusal(page: Window) -> None:
    page.click(".nav a", "Devices")
    row = ROW.format("ctd.sample_period_s")
    until(lambda: "good" in page.text(row), "the value is read")
    page.click(f"{row} button", "Write")
    page.type("dialog input", "7")
    page.sees("dialog strong", "7")
    page.click("dialog footer button", "Write")
    page.sees("dialog .error", "cannot be commanded by this client")  # a program commands this tag
    page.click("dialog footer button", "Cancel")
    until(lambda: not page.elements("dialog"), "the dialog is closed")
    assert all("403" in text for text in page.complaints())  # the browser notes the refused request


def test_trends_show_marks_differences_between_cursors_and_a_zoom_that_is_reset(
    page: Window, observatory: Studio
) -> None:
    with observatory.client() as client:
        client.post("/instances/observatory/faults", json={"fault": {"name": "silence", "device": "ctd"}})
        page.go(f"{observatory.url}#/observatory/trends?tags=inclinometer.slope_long")
        page.sees("summary", "marks")
        client.delete("/instances/observatory/faults")
    page.click("summary", "marks")
    page.sees(".marks", "silence on ctd, cleared")
    page.click("button", "Cursors")
    page.sees(".cursors", "B − A = ")
    page.sees(".cursors td", "inclinometer.slope_long")
    over = page.elements(".u-over")[0]
    ActionChains(page.driver).move_to_element(over).click_and_hold().move_by_offset(150, 0).release().perform()
    page.click("button", "Reset zoom")
    until(lambda: not page.elements("button", "Reset zoom"), "the zoom is reset")
    page.click("button", "Remove cursors")
    until(lambda: not page.elements(".cursors"), "the cursors are removed")


def test_the_timeline_of_a_scenario_has_the_verdict_of_each_step_and_check(page: Window) -> None:
    page.click(".nav a", "Scenario")
    page.sees("main", "CTD falls silent")
    [option] = [o for o in page.text("main select").splitlines() if "ctd-silent" in o]
    page.choose("Scenario", option.strip())
    page.click("button", "Run")
    page.sees("[data-step='12'] .chip", "passed")
    page.sees("[data-step='always 1'] .chip", "passed")
    page.sees("main [role=status] .chip", "passed")
    page.sees(".u-legend", "ctd.pressure")


def test_a_page_takes_the_start_time_of_the_new_run_when_a_run_starts_under_the_same_name(
    page: Window, observatory: Studio
) -> None:
    folder = observatory.run_root / "again"
    folder.mkdir(mode=0o700)
    shutil.copy(observatory.run_root / "observatory" / SYSTEM_FILE, folder / SYSTEM_FILE)
    first = read_record(observatory.run_root / "observatory")
    assert first is not None
    try:
        write_record(folder, structs.replace(first, started_ns=time.monotonic_ns() - 5000 * 10**9, capture=""))
        page.go(f"{observatory.url}#/again/trends")
        page.sees("main", "recorded since 1:2")
        write_record(folder, structs.replace(first, started_ns=time.monotonic_ns(), capture=""))
        page.sees("main", "recorded since 0:0")
    finally:
        page.go(f"{observatory.url}#/observatory/overview")
        page.sees(".plan", "ctd")  # the page of the other instance is closed before its folder is gone
        shutil.rmtree(folder)


def test_a_value_that_does_not_change_has_a_sparkline_when_the_page_is_opened(page: Window) -> None:
    page.click(".nav a", "Devices")
    path = f"{ROW.format('inclinometer.serial')} .spark path"  # no change of this tag can arrive while the page is open
    line = until(
        lambda: page.script("return document.querySelector(arguments[0])?.getAttribute('d')", path), "its line"
    )
    assert line.startswith("M")
