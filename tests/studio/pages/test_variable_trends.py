"""Trends of program variables and tags in a real Chromium: units, names of values, and the number of scans that are shown."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from studio_rig import OPERATE, studio, until

pytest.importorskip("selenium", reason="needs selenium, which is in the extra dev")
from accessibility_rules import MISSING as NO_AXE
from accessibility_rules import violations
from browser import MISSING, Window, browser

pytestmark = [pytest.mark.long, pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.timeout(180)]

TANK = Path(__file__).parents[3] / "examples" / "first-bug"
PROGRAM = """
TYPE Modes : (IDLE, FILLING); END_TYPE
PROGRAM Fill
VAR_INPUT level : REAL; END_VAR
VAR_OUTPUT run : BOOL; END_VAR
VAR due : TIME := T#1s500ms; day : DATE := D#2026-11-29; modes : ARRAY[1..2] OF Modes; settled : TON; END_VAR
  settled(IN := TRUE, PT := T#2s);
  modes[2] := Modes#FILLING;
END_PROGRAM
"""


VARIABLES = ("fill.settled.ET", "fill.modes[2]", "fill.settled.Q", "fill.due")


def add(page: Window, name: str) -> None:
    page.type(".add-variable input", name)
    page.click(".add-variable button")


def test_variables_are_added_to_the_trends_of_tags_with_units_names_and_scans(tmp_path: Path) -> None:
    shutil.copytree(TANK, tmp_path / "tank")
    (tmp_path / "tank" / "fill.st").write_text(PROGRAM)
    with studio("tank.yaml", folder=tmp_path / "tank") as running, browser() as page:
        page.go(f"{running.url}?token={OPERATE}#/tank/plc")
        page.sees("tr[data-tag='fill.due']", "T#1s500ms")
        page.sees("tr[data-tag='fill.day']", "D#2026-11-29")
        page.click("summary", "Variables that are not tags")
        page.sees("tr[data-variable='fill.settled.PT']", "T#2s")
        page.click("tr[data-variable='fill.settled.ET'] a", "Trend")
        page.sees(".trend .scans", "fill.settled.ET: all")
        for name in VARIABLES[1:]:
            add(page, name)
            page.sees(".trend .scans", f"{name}: all")
        page.choose("Add", "sensor.level")
        page.sees(".trend", "sensor.level")
        add(page, "fill.nothing")
        page.sees("[role=alert]", "no variable 'fill.nothing'")
        page.sees(".trend .scans", "fill.due: all")

        page.click("button", "all")
        page.click("button", "Hold")
        page.click("button", "Cursors")
        page.script(
            "const b = document.querySelector('[aria-label=\"Cursor B\"]'); b.value = 1000;"
            "b.dispatchEvent(new Event('input', {bubbles: true}))"
        )
        rows = until(lambda: values_at_b(page), "cursor B has a value of each series")
        assert rows["fill.modes[2]"] == ("FILLING", "")
        assert rows["fill.settled.Q"][0] in ("FALSE", "TRUE")
        assert rows["fill.due"] == ("1.5", "s")
        assert rows["fill.settled.ET"][1] == "s"
        assert 0 < float(rows["fill.settled.ET"][0]) <= 2
        if not NO_AXE:
            for dark in (False, True):
                page.dark(dark)
                assert violations(page) == []
        answers = [one for one in page.complaints() if "fill.nothing" not in one]
        assert answers == []


SCENARIO = """scenario: the mode is reached
system: ./tank.yaml
steps:
  - pause: 3s
"""


def test_a_trace_shows_the_variables_that_its_scenario_has_recorded(tmp_path: Path) -> None:
    folder = tmp_path / "tank"
    shutil.copytree(TANK, folder)
    (folder / "fill.st").write_text(PROGRAM)
    (folder / "mode.scenario.yaml").write_text(SCENARIO)
    chosen = [text for name in VARIABLES for text in ("--variable", name)]
    command = [sys.executable, "-m", "fieldtwin", "test", "mode.scenario.yaml", *chosen]
    refused = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)
    assert (refused.returncode, "--trace FILE" in refused.stderr) == (2, True)
    subprocess.run([*command, "--trace", "run.jsonl"], cwd=folder, check=True, capture_output=True, timeout=120)
    query = "&".join(f"variable={name}" for name in VARIABLES)
    with studio("run.jsonl", folder=folder) as running, browser() as page:
        page.go(f"{running.url}?token={OPERATE}#/trace%3Arun.jsonl/trends?t=2.5&{query}")
        page.click("button", "Cursors")
        rows = until(lambda: values_at_b(page), "cursor B has a value of each series")
        assert rows["fill.modes[2]"] == ("FILLING", "")
        assert rows["fill.settled.Q"] == ("FALSE", "")
        assert rows["fill.due"] == ("1.5", "s")
        assert 1.6 < float(rows["fill.settled.ET"][0]) < 1.7  # at two thirds of 2.5 s
        assert rows["fill.settled.ET"][1] == "s"
        page.click(".nav a", "PLC")
        page.sees("tr[data-tag='fill.settled.ET']", "T#2s")
        if not NO_AXE:
            assert violations(page) == []
        assert page.complaints() == []


def values_at_b(page: Window) -> dict[str, tuple[str, str]]:
    """Return the value and the unit of each series at cursor B; nothing while one is missing."""
    lines = page.text(".cursors tbody tr").split("\n")
    rows = {
        cells[0]: (cells[2], cells[4] if len(cells) > 4 else "") for line in lines if len(cells := line.split("\t")) > 3
    }
    ready = set(VARIABLES) <= set(rows) and not any(re.match("no value|not", rows[name][0]) for name in VARIABLES)
    return rows if ready else {}
