"""Studio's pages in a real Chromium, driven as a user would: with clicks and keys, and read as the screen shows them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from studio_rig import OPERATE, VIEW, Studio, studio, until

pytest.importorskip("selenium", reason="needs selenium, which is in the extra dev")
from browser import MISSING, Window, browser

pytestmark = [pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.timeout(180)]

VIEWS = ("Overview", "Devices", "Bus", "PLC", "Trends", "Faults")
ROW = "tr[data-tag='{}']"


@pytest.fixture(scope="module")
def chromium() -> Iterator[Window]:
    with browser() as window:
        yield window


@pytest.fixture
def page(chromium: Window, observatory: Studio) -> Iterator[Window]:
    """The overview of the observatory, with the role operate. No view may complain in the console."""
    opened(chromium, observatory, OPERATE)
    chromium.complaints()
    yield chromium
    with observatory.client() as client:
        client.delete("/instances/observatory/faults")
        client.delete("/instances/observatory/plc/forces")
    assert chromium.complaints() == []


def opened(window: Window, running: Studio, token: str) -> None:
    window.go("about:blank")
    window.go(running.url)
    window.driver.delete_all_cookies()
    window.go(f"{running.url}?token={token}")
    window.click("a", "observatory")
    window.sees(".top", "live")


def test_a_silent_device_is_seen_in_every_view_until_the_fault_is_cleared(page: Window) -> None:
    page.sees(".plan", "ctd")
    page.click(".nav a", "Devices")
    until(lambda: "good" in page.text(ROW.format("ctd.status")), "the sensor is read")

    page.click(".nav a", "Faults")
    page.choose("Fault", "silence")
    page.choose("device", "ctd")
    assert "{name: silence, device: ctd}" in page.text("pre.yaml")
    page.click("form button", "Inject")
    page.sees(".banners", "silence on ctd")
    page.sees(".nav .count", "1")

    page.click(".nav a", "Devices")
    shown = page.sees(ROW.format("ctd.status"), "bad")
    assert "bad: timeout" in shown or "bad: stale" in shown

    page.click(".nav a", "Overview")
    page.sees(".plan", "fault: silence")

    page.click(".nav a", "Bus")
    page.choose("Device", "ctd")
    page.click("label", "only problems")
    page.sees(".frames .item", "no reply")
    assert all("no reply" in row.text for row in page.elements(".frames .item"))

    page.click(".banner a", "Show")
    page.click("button", "Clear all")
    page.sees("main", "No fault is active.")
    page.lacks(".banners", "silence")
    page.click(".nav a", "Devices")
    until(lambda: "good" in page.text(ROW.format("ctd.status")), "the sensor is read again")


def test_a_value_is_set_in_the_simulated_device_and_released(page: Window) -> None:
    row = ROW.format("ctd.sample_period_s")
    page.click(".nav a", "Devices")
    page.click(f"{row} button", "Set")
    page.type("dialog input", "7")
    page.click("dialog button", "Set")
    page.sees(f"{row} .chip", "set")
    page.sees(f"{row} td.number", "7")
    page.sees(".banners", "ctd.sample_period_s set to 7")
    page.click(f"{row} button", "Release")
    page.lacks(".banners", "sample_period_s")
    until(lambda: "\n7\n" not in f"\n{page.text(f'{row} td.number')}\n", "the device has its own value again")


def test_a_view_that_throws_shows_the_error_and_the_page_goes_on(page: Window) -> None:
    breaks = """const includes = String.prototype.includes;
        String.prototype.includes = function (text, ...more) {
          if (text === "break it") throw new Error("broken on purpose");
          return includes.call(this, text, ...more);
        };"""
    page.script(breaks)
    page.click(".nav a", "Devices")
    ways = (lambda: page.click("button", "Try again"), lambda: page.click(".nav a", "Devices"))
    for go_on in ways:
        page.type("[type=search]", "break it")
        page.sees("main [role=alert]", "broken on purpose")
        page.sees(".top", "live")
        go_on()
        page.sees("main", "ctd.status")
        assert any("broken on purpose" in line for line in page.complaints())
        assert not page.elements("main [role=alert]")
    page.type("[type=search]", "break it")
    page.click(".nav a", "Overview")
    page.sees(".plan", "ctd")
    page.complaints()


def test_the_page_replaces_the_note_that_it_is_loading(page: Window) -> None:
    page.lacks("body", "Loading the page")


def test_a_page_whose_frame_throws_offers_to_load_it_again(page: Window) -> None:
    page.click(".nav a", "Devices")
    page.sees("main", "ctd.status")
    page.script("Object.entries = () => { throw new Error('broken on purpose'); };")  # the next update draws the frame
    page.sees("[role=alert]", "Studio's page cannot be shown")
    page.click("button", "Load the page again")
    page.sees(".top", "live")
    page.sees("main", "ctd.status")
    page.complaints()


def test_an_address_that_is_cut_off_names_what_is_missing(page: Window, observatory: Studio) -> None:
    page.go(f"{observatory.url}#/%E0%A4%A")
    page.sees("main .error", "%E0%A4%A")
    page.click("a", "All instances")
    page.sees("h2", "Running")
    page.complaints()


def test_a_force_is_visible_on_every_view_until_it_is_removed(page: Window) -> None:
    row = ROW.format("ctd.sample_count")
    page.click(".nav a", "PLC")
    page.click(f"{row} button", "Force")
    page.type("dialog input", "5")
    page.click("dialog footer button", "Force")
    for view in VIEWS:
        page.click(".nav a", view)
        page.sees(".nav a[aria-current]", view)
        page.sees(".banner", "ctd.sample_count = 5")
    page.click(".banner button", "Remove all forces")
    page.lacks(".banners", "ctd.sample_count")


def test_the_role_view_shows_no_operating_control(page: Window, observatory: Studio) -> None:
    opened(page, observatory, VIEW)
    page.sees(".top", "view only")
    for view in VIEWS:
        page.click(".nav a", view)
        page.sees(".nav a[aria-current]", view)
        page.sees("main", "")
        shown = set(page.text("button").splitlines())
        assert not {
            t for t in shown if t.startswith(("Set", "Force", "Inject", "Clear", "Release", "Remove all", "Step"))
        }
        if view != "Bus":  # there, pause stops the table only
            assert "Pause" not in shown
        assert not page.elements("form:not(.add-variable)")  # which only chooses what the page shows


def test_no_view_has_an_error_or_a_violation_of_the_policy_in_the_console(page: Window) -> None:
    for view in VIEWS:
        page.click(".nav a", view)
        page.sees(".nav a[aria-current]", view)
        until(lambda: page.elements("main > :not(h1)"), f"{view} is drawn")
    page.click(".brand")
    page.sees("h2", "Running")
    assert page.complaints() == []


def test_every_step_of_the_commissioning_guide_is_drawn_and_shows_its_command_line(page: Window) -> None:
    page.click(".brand")
    page.click("a", "Open the guide")
    page.type("#field-endpoint", "tcp://192.0.2.1:502")
    for step in ("Listen", "Scan", "Identify", "Dump", "Check"):
        page.click(".steps a", step)
        page.sees("h1", step)
        command = "check modbus" if step == "Check" else "line" if step == "Listen" else step.lower()
        page.sees("#command-line", f"fieldtwin {command} tcp://192.0.2.1:502")
    page.click(".steps a", "Edit")
    page.sees("main", "No profile yet")


def test_a_violation_of_the_policy_is_a_complaint(page: Window) -> None:
    page.script("const s = document.createElement('script'); s.textContent = 'window.bad = 1'; document.body.append(s)")
    assert any("Content Security Policy" in text for text in page.complaints())
    assert not page.script("return window.bad")


@pytest.mark.long
def test_a_prototype_is_started_from_the_list_and_old_values_are_named_when_the_server_is_lost(
    chromium: Window, tmp_path: Path
) -> None:
    with studio(folder=hostile_site(tmp_path)) as running:
        chromium.go("about:blank")
        chromium.go(running.url)
        chromium.driver.delete_all_cookies()
        chromium.complaints()
        chromium.go(running.page)
        chromium.sees("main", "Nothing runs on this computer.")
        chromium.sees(".card", "<b>'site")
        chromium.click(".card button", "Start")  # the systems of the folder come first
        chromium.sees(".top", "live")
        for view in VIEWS:
            chromium.click(".nav a", view)
            chromium.sees(".nav a[aria-current]", view)
            assert not chromium.script("return document.querySelectorAll('#app b, #app img, #app script').length")
            if view in ("Overview", "Devices"):
                chromium.sees("main", HOSTILE)
                chromium.sees("main", "<script>")
        assert chromium.complaints() == []
        running.process.terminate()
        chromium.sees(".banner[role=alert]", "values below are old")
        chromium.sees(".top", "not connected")


HOSTILE = "<b>\"'"
"""A unit and, without the double quote, a file name. Names of devices and tags cannot contain such characters."""


def hostile_site(folder: Path) -> Path:
    """A system whose texts would be markup if a page did not escape them."""
    (folder / "meter.yaml").write_text(
        """device: test/meter
source: "a test"
protocol: modbus
tags:
  level: {at: 30001, type: uint16, unit: "<b>\\"'"}
  mode: {at: 40001, type: uint16, values: {0: "<script>alert(1)</script>"}}
"""
    )
    (folder / "<b>'site.yaml").write_text(
        """fieldtwin: 1
system: hostile
buses:
  lan: {url: "tcp://192.0.2.1:502"}
devices:
  meter: {profile: ./meter.yaml, bus: lan, unit: 1, poll: {values: {every_ms: 200}}}
"""
    )
    (folder / "<b>'site.prototype.yaml").write_text(
        """prototype_of: "<b>'site.yaml"
buses:
  lan: {listen: "tcp://127.0.0.1:0"}
simulations:
  pond: {formulas: {level: 3, mode: 0}}
devices:
  meter: {simulation: pond}
"""
    )
    return folder
