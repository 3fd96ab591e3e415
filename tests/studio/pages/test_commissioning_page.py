"""The commissioning guide in a real Chromium: the first hour with a device, and practice with an emulated one."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from studio_rig import OPERATE, VIEW, Studio, studio, until

pytest.importorskip("selenium", reason="needs selenium, which is in the extra dev")
from accessibility_rules import MISSING as NO_AXE
from accessibility_rules import violations
from browser import MISSING, Window, browser

METER = Path(__file__).parents[3] / "examples" / "unknown-device" / "flow_meter.py"
SOCAT = shutil.which("socat") or ""

pytestmark = [pytest.mark.long, pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.timeout(600)]

PROFILE = """device: mysite/flow-meter
source: "read from the device, compared with its display"
protocol: modbus
factory: {baudrate: 9600, frame: 8N1, unit: 3}
tags:
  flow: {at: 30001, type: float32, order: CDAB, unit: m3/h}
  span: {at: 40001, type: uint16, unit: m3/h, access: rw}
"""


@contextmanager
def flow_meter(folder: Path) -> Iterator[None]:
    """Connect two virtual serial ports `near` and `far`, with the flow meter of the tutorial at `far`."""
    ends = [f"pty,raw,echo=0,link={folder / name}" for name in ("near", "far")]
    cable = subprocess.Popen([SOCAT, *ends])
    try:
        until(lambda: (folder / "far").exists(), "the cable is there")
        meter = subprocess.Popen(
            [sys.executable, str(METER), str(folder / "far")], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        try:
            assert meter.stdout is not None
            assert b"answers" in meter.stdout.readline()
            yield
        finally:
            meter.kill()
            meter.communicate()
    finally:
        cable.kill()
        cable.wait()


def opened(window: Window, running: Studio, token: str = OPERATE) -> None:
    window.go("about:blank")
    window.go(running.url)
    window.driver.delete_all_cookies()
    window.go(f"{running.url}?token={token}")
    window.complaints()
    window.click("a", "Open the guide")
    window.sees("h1", "Port")


def go_to(window: Window, title: str) -> None:
    def there() -> bool:
        window.click(".steps a", title)  # again, if the page moved under the pointer
        return title in window.text("h1")

    until(there, f"the step {title} is shown")


def play(window: Window, title: str, ends: str, **values: str) -> str:
    """Fill in the form of a step, start it, wait for its end, and return what the page shows of the result."""
    go_to(window, title)
    for name, value in values.items():
        window.type(f"[name={name}]", value)
    window.click("form button.primary", title)
    window.sees(".outcome .chip", ends)
    return until(lambda: window.text(".outcome"), f"the result of {title}")


@pytest.mark.interop
@pytest.mark.skipif(not SOCAT, reason="needs Debian's package socat")
def test_the_first_hour_with_an_unknown_device(tmp_path: Path) -> None:
    with flow_meter(tmp_path), studio(folder=tmp_path) as running, browser() as page:
        opened(page, running)
        page.type("#field-endpoint", "rtu:near")
        page.type("#field-name", "meter")

        play(page, "Listen", "done", listen_s="1")
        page.sees(".outcome", "no client sends requests")
        play(page, "Scan", "done", listen_s="1")
        page.sees(".outcome td", "9600 8N1")
        page.sees(".outcome td", "in use")

        go_to(page, "Identify")
        page.sees("#command-line", "fieldtwin identify 'rtu:near?baudrate=9600&frame=8N1' --unit 3")
        play(page, "Identify", "findings")
        page.sees(".outcome", "FM-300")
        page.sees(".outcome", "no known profile fits")
        page.type("[name=address]", "3")  # the result is drawn again: this once stopped all drawing of the page
        page.sees(".outcome dl", "SunSpec\nno header")

        play(page, "Dump", "done", ranges="input:0..15 holding:0..15", passes="8", every_s="0.5")
        page.sees(".outcome", "10 values in 8 passes")
        page.sees(".outcome td", "input:0..7")
        play(page, "Infer", "done")
        page.sees(".outcome tr", "float32 CDAB")

        go_to(page, "Edit")
        page.sees("#draft-errors", "valid")
        page.type(".editor textarea", PROFILE.replace("float32", "float33"))
        page.sees(".problems", "line 6")
        page.sees(".editor .gutter .bad", "6")
        page.type(".editor textarea", PROFILE)
        page.sees("#draft-errors", "mysite/flow-meter, 2 tags")
        page.click("main button", "Save")
        page.sees("main", "Saved meter.yaml.")
        assert (tmp_path / "meter.yaml").read_text() == PROFILE

        play(page, "Record", "done", rounds="4", every_s="0.5")
        page.sees(".outcome", "in 4 rounds")
        go_to(page, "Emulate")
        page.click("form button", "Emulate")
        page.sees(".messages", "units 3 on copy")
        play(page, "Compare", "done")
        page.sees(".outcome", "8 of 8 exchanges are equal")
        go_to(page, "Emulate")
        page.click("form button", "Stop")
        page.sees(".outcome .chip", "stopped")

        play(page, "Check", "findings")  # pymodbus 3.16.1 deviates from the standard
        page.sees(".outcome td", "MB-038")
        play(page, "Report", "done", site="Pump house 3", label="Flow meter F3")
        page.sees(".outcome", "1 device,")
        document = (tmp_path / "meter-acceptance.html").read_text()
        assert "Pump house 3" in document
        assert "Flow meter F3" in document
        site = "fieldtwin new mysite --device 'meter=./meter.yaml@rtu:near?baudrate=9600&frame=8N1#3' --yes"
        page.sees(".finish pre", site)
        subprocess.run([sys.executable, "-m", *shlex.split(site)], cwd=tmp_path, check=True, capture_output=True)
        assert (tmp_path / "mysite" / "profiles" / "meter.yaml").read_text().endswith(PROFILE)

        states = page.text(".steps").splitlines()
        assert states.count("done") == 9, states
        page.driver.refresh()
        page.sees(".top", "rtu:near")
        assert page.complaints() == []


@pytest.mark.skipif(bool(NO_AXE), reason=NO_AXE)
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_no_step_violates_a_rule_of_wcag_2_a_or_aa(tmp_path: Path, dark: bool) -> None:
    (tmp_path / "meter.yaml").write_text(PROFILE.replace("float32", "float33"))
    with studio(folder=tmp_path) as running, browser() as page:
        page.dark(dark)
        opened(page, running)
        page.type("#field-endpoint", "tcp://127.0.0.1:1")
        play(page, "Listen", "f")  # it fails, or names findings: nothing listens there
        found = {}
        for link in range(len(page.elements(".steps a"))):
            title = page.elements(".steps a")[link].text.split("\n")[0].split(" ")[-1]
            go_to(page, title)
            if title == "Edit":
                page.sees(".problems", "line 6")
            found[title] = violations(page)
        assert len(found) == 12
        assert {title: broken for title, broken in found.items() if broken} == {}


def test_the_guide_is_tried_with_an_emulated_device_and_the_role_view_only_looks(tmp_path: Path) -> None:
    with studio(folder=tmp_path) as running, browser() as page:
        opened(page, running)
        page.click("button", "Practise with an emulated device")
        page.sees(".practice", "answers on rtu:practice")
        go_to(page, "Scan")
        page.sees("#command-line", "fieldtwin scan rtu:practice --quick")
        page.type("[name=listen_s]", "60")
        page.click("form button.primary", "Scan")
        page.sees(".messages", "listening")
        page.sees(".steps [data-step=scan]", "running")
        page.click("form button", "Stop")
        page.sees(".outcome", "The list is not complete.")
        page.sees(".steps [data-step=scan]", "stopped")
        assert page.complaints() == []

        opened(page, running, VIEW)
        page.sees(".top", "view only")
        go_to(page, "Scan")
        page.sees("#command-line", "fieldtwin scan")
        page.sees(".outcome", "The list is not complete.")
        assert not page.elements("main button.primary, main button.danger")
        assert page.complaints() == []


def test_a_typed_unit_id_is_that_of_the_next_steps_and_a_refused_function_does_not_answer(tmp_path: Path) -> None:
    (tmp_path / "heat.yaml").write_text(PROFILE.replace("unit: 3", "unit: 17"))
    with studio(folder=tmp_path) as running, browser() as page:
        with running.client() as client:
            step = {"step": "emulate", "what": "heat.yaml", "on": "pty:line"}
            assert client.post("/commissioning/jobs", json={"step": step}).status_code == 200
        until(lambda: (tmp_path / "line").exists(), "the emulated device listens")
        opened(page, running)
        page.type("#field-endpoint", "rtu:line")
        go_to(page, "Identify")
        page.type("[name=address]", "17")
        page.click("form button.primary", "Identify")
        page.sees(".outcome .chip", "f")  # findings: no shipped profile fits
        go_to(page, "Dump")
        page.sees("#command-line", "fieldtwin dump rtu:line --unit 17")
        play(page, "Dump", "done", ranges="holding:0..1", passes="1")
        page.sees(".outcome .mono", "07h, 08h, 0Bh, 0Ch")  # 11h and 2Bh are refused
        assert "11h" not in page.text(".outcome")
