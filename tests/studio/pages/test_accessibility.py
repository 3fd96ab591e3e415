"""Every view of Studio keeps the rules of WCAG 2 A and AA, contrast included, and can be operated with the keyboard alone."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from studio_rig import Studio, until

pytest.importorskip("selenium", reason="needs selenium, which is in the extra dev")
from accessibility_rules import MISSING as NO_AXE
from accessibility_rules import violations
from browser import MISSING, Window, browser
from selenium.webdriver.common.keys import Keys

pytestmark = [pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.long, pytest.mark.timeout(180)]
needs_axe = pytest.mark.skipif(bool(NO_AXE), reason=NO_AXE)

NAME = "/instances/observatory"
MOST_TABS = 150  # more than any view has elements
ROW = "tr[data-tag='ctd.sample_period_s']"


@pytest.fixture(scope="module")
def chromium() -> Iterator[Window]:
    with browser() as window:
        yield window


@pytest.fixture
def page(chromium: Window, observatory: Studio) -> Iterator[Window]:
    """The overview of the observatory's prototype."""
    chromium.go("about:blank")
    chromium.go(f"{observatory.page}#/observatory")
    chromium.sees(".top", "live")
    yield chromium
    with observatory.client() as client:
        for path in ("/faults", "/plc/forces", "/tags/ctd.sample_period_s/set"):
            client.delete(NAME + path)
    chromium.dark(False)


def views(window: Window) -> list[str]:
    """Return the titles of all views that the page offers, so that a new view is covered without a change here."""
    titles = [link.text.split("\n")[0].strip() for link in window.elements(".nav a")]
    assert "Overview" in titles
    return titles


def shown(window: Window, view: str) -> None:
    """Open a view with its link, and wait until it is drawn."""
    window.click(".nav a", view)
    window.sees(".nav a[aria-current]", view)
    until(lambda: window.elements("main > :not(h1)"), f"{view} is drawn")


@needs_axe
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_no_view_violates_a_rule_of_wcag_2_a_or_aa(page: Window, observatory: Studio, dark: bool) -> None:
    page.dark(dark)
    with observatory.client() as client:  # so that banners, counts and marked rows are on the page
        client.post(f"{NAME}/faults", json={"fault": {"name": "silence", "device": "ctd"}}).raise_for_status()
        client.post(f"{NAME}/plc/forces", json={"tag": "ctd.sample_count", "value": 5}).raise_for_status()
    page.sees(".banners", "silence on ctd")
    page.sees(".banners", "ctd.sample_count = 5")
    found = {}
    for view in views(page):
        shown(page, view)
        found[view] = violations(page)
    shown(page, "Devices")
    page.click(f"{ROW} button", "Set")
    page.sees("dialog", "Value")
    found["a dialog"] = violations(page)
    page.press(Keys.ESCAPE)
    page.click(".brand")
    page.sees("h2", "Running")
    found["the list of instances"] = violations(page)
    assert {view: broken for view, broken in found.items() if broken} == {}


@needs_axe
def test_a_text_with_little_contrast_is_a_violation(page: Window) -> None:
    page.script(
        "const p = document.createElement('p'); p.textContent = 'hardly seen';"
        "p.style.color = '#ccc'; p.style.background = '#fff'; document.querySelector('main').append(p)"
    )
    assert [text for text in violations(page) if text.startswith("color-contrast") and "hardly seen" in text]


def tab_to(window: Window, css: str, text: str = "") -> None:
    """Press the tab key until an element has the focus that matches and whose text contains `text`."""
    for _ in range(MOST_TABS):
        window.press(Keys.TAB)
        if focused(window, css, text):
            return
    raise AssertionError(f"the tab key does not reach {css} with the text {text!r}")


def focused(window: Window, css: str, text: str = "") -> bool:
    """Return whether an element has the focus that matches and whose text contains `text`."""
    return bool(
        window.script(
            "const e = document.activeElement; return e.matches(arguments[0]) && e.textContent.includes(arguments[1])",
            css,
            text,
        )
    )


def test_a_prototype_is_operated_with_the_keyboard_alone(page: Window) -> None:
    def follow(view: str) -> None:
        tab_to(page, ".nav a", view)
        page.press(Keys.ENTER)
        page.sees(".nav a[aria-current]", view)
        until(lambda: focused(page, "main"), "the new view has the focus")

    for view in views(page):
        follow(view)
    follow("Overview")

    tab_to(page, ".plan a[href*='device=ctd']")
    page.press(Keys.ENTER)
    page.sees("main", "ctd.sample_period_s")
    until(lambda: focused(page, "main"), "the opened device has the focus")

    tab_to(page, f"{ROW} button", "Set")
    page.press(Keys.ENTER)
    until(lambda: focused(page, "dialog input"), "the field of the dialog has the focus")
    page.press(Keys.ESCAPE)
    until(lambda: not page.elements("dialog"), "the dialog is closed")
    assert focused(page, f"{ROW} button", "Set"), "after Escape, the button that opened the dialog has the focus"

    page.press(Keys.ENTER)
    until(lambda: focused(page, "dialog input"), "the field of the dialog has the focus")
    page.type("dialog input", "7")
    page.press(Keys.ENTER)
    page.sees(f"{ROW} .chip", "set")
    until(lambda: focused(page, f"{ROW} button", "Release"), "the button of the row has the focus again")
    page.press(Keys.ENTER)
    page.lacks(".banners", "sample_period_s")

    follow("Faults")
    tab_to(page, "form select")
    page.press("silence")
    tab_to(page, "form select")
    page.press("ctd")
    tab_to(page, "form button", "Inject")
    page.press(Keys.ENTER)
    page.sees(".banners", "silence on ctd")
    tab_to(page, "button", "Clear all")
    page.press(Keys.ENTER)
    page.sees("main", "No fault is active.")

    follow("PLC")
    tab_to(page, "tr button", "Why?")
    page.press(Keys.ENTER)
    page.sees("dialog", "Why does")
    tab_to(page, "dialog button", "Close")
    page.press(Keys.ENTER)
    until(lambda: not page.elements("dialog"), "the dialog is closed")
    assert focused(page, "tr button", "Why?"), "after Close, the button that opened the dialog has the focus"
