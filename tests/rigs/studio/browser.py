"""A headless Chromium for tests of Studio's pages. Actions are those of a user; text is read as the screen shows it."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from selenium import webdriver
from selenium.common.exceptions import (
    ElementClickInterceptedException,
    ElementNotInteractableException,
    JavascriptException,
    NoSuchElementException,
    StaleElementReferenceException,
)
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.ui import Select
from studio_rig import until

CHROMIUM, DRIVER = shutil.which("chromium") or "", shutil.which("chromedriver") or ""
MISSING = "" if CHROMIUM and DRIVER else "needs Debian's packages chromium and chromium-driver"
WIDE, TABLET = (1280, 720), (800, 1100)
_REDRAWN = (
    ElementClickInterceptedException,
    ElementNotInteractableException,
    JavascriptException,  # the page was left meanwhile
    NoSuchElementException,
    StaleElementReferenceException,
)
# One script looks at all elements at once: a list that follows a bus replaces its rows faster than a loaded computer can ask for
# each of them. A state diagram has no innerText, because it is an SVG.
_VISIBLE = """
const visible = (css) => [...document.querySelectorAll(css)].filter(
  (e) => e.getClientRects().length && e.checkVisibility({opacityProperty: true, visibilityProperty: true}));
const text = (e) => (e.innerText ?? e.textContent).trim();
"""
_STEADY = """
const [element, answer] = arguments, place = () => { const r = element.getBoundingClientRect(); return `${r.x} ${r.y}`; };
const before = place(), frame = requestAnimationFrame;
frame(() => frame(() => answer(!element.disabled && place() === before)));
"""
T = TypeVar("T")


class Window:
    """A window of the browser. Each action waits until the page has the element, because the page is drawn again often."""

    def __init__(self, driver: webdriver.Chrome) -> None:
        self.driver = driver

    def go(self, url: str) -> None:
        self.driver.get(url)

    def elements(self, css: str, text: str = "") -> list[WebElement]:
        """Return the visible elements whose text contains `text`."""
        source = _VISIBLE + "return visible(arguments[0]).filter(e => text(e).includes(arguments[1]))"
        return list(self.script(source, css, text))

    def usable(self, css: str, text: str) -> WebElement | None:
        """Return the first of these elements if it is enabled and stays at its place for two frames of the display.

        The browser ignores a click on a disabled button, and a click where a moving element was reaches another element.
        """
        found = self.elements(css, text)
        return found[0] if found and self.driver.execute_async_script(_STEADY, found[0]) else None

    def text(self, css: str) -> str:
        """Return the visible text of all elements that match. Without such an element the text is empty."""
        return str(self.script(_VISIBLE + "return visible(arguments[0]).map(text).join('\\n')", css))

    def sees(self, css: str, text: str) -> str:
        """Wait until an element shows a text, and return the text of all elements that match."""
        return until(lambda: text in (found := self.text(css)) and found, f"{css} shows {text!r}")

    def lacks(self, css: str, text: str) -> None:
        """Wait until no element shows a text."""
        until(lambda: text not in self.text(css), f"{css} does not show {text!r}")

    def click(self, css: str, text: str = "") -> None:
        """Click on the first visible element whose text contains `text`."""
        self._act(css, text, lambda element: element.click())

    def choose(self, label: str, choice: str) -> None:
        """Choose an option of the list with this label."""
        self._act(
            "label", label, lambda e: Select(e.find_element(By.TAG_NAME, "select")).select_by_visible_text(choice)
        )

    def type(self, css: str, text: str) -> None:
        """Replace the content of a text field."""
        self._act(css, "", lambda e: e.send_keys(Keys.CONTROL + "a" + Keys.NULL + text))

    def press(self, *keys: str) -> None:
        """Press keys. The element that has the focus then receives them."""
        ActionChains(self.driver).send_keys(*keys).perform()

    def size(self, width: int, height: int) -> None:
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)

    def dark(self, on: bool) -> None:
        """Let the system's setting be dark or light."""
        feature = {"name": "prefers-color-scheme", "value": "dark" if on else "light"}
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})

    def script(self, source: str, *arguments: Any) -> Any:
        return self.driver.execute_script(source, *arguments)

    def complaints(self) -> list[str]:
        """Return the errors in the console since the last call: exceptions, failed requests, violations of the policy."""
        return [entry["message"] for entry in self.driver.get_log("browser") if entry["level"] == "SEVERE"]

    def _act(self, css: str, text: str, action: Callable[[WebElement], Any]) -> None:
        def attempt() -> bool:
            try:
                found = self.usable(css, text)
                if found:
                    action(found)
            except _REDRAWN:
                return False
            return bool(found)

        until(attempt, f"{css} with the text {text!r} can be used")


@contextmanager
def browser() -> Iterator[Window]:
    """Start Chromium, and end it."""
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    try:
        window = Window(driver)
        window.size(*WIDE)
        yield window
    finally:
        driver.quit()
