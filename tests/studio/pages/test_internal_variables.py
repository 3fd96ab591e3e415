"""The page PLC shows variables of a running program that are not tags, in a real Chromium."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from studio_rig import OPERATE, VIEW, studio, until

pytest.importorskip("selenium", reason="needs selenium, which is in the extra dev")
from browser import MISSING, browser

pytestmark = [pytest.mark.long, pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.timeout(180)]

TANK = Path(__file__).parents[3] / "examples" / "first-bug"
PROGRAM = """
PROGRAM Fill
VAR_INPUT level : REAL; END_VAR
VAR_OUTPUT run : BOOL; END_VAR
VAR settled : TON; name : STRING[10] := 'P1'; levels : ARRAY[1..400] OF REAL; many : ARRAY[1..300] OF TON; END_VAR
  settled(IN := TRUE, PT := T#1h);
  levels[2] := 1.5;
END_PROGRAM
"""


def test_members_of_blocks_arrays_and_strings_are_shown_and_change(tmp_path: Path) -> None:
    shutil.copytree(TANK, tmp_path / "tank")
    (tmp_path / "tank" / "fill.st").write_text(PROGRAM)
    with studio("tank.yaml", folder=tmp_path / "tank") as running:
        with running.client(VIEW) as client:
            answer = until(lambda: client.get("/instances/tank/plc/internal").json(), "the PLC answers")
        assert {"name": "fill.name", "type": "STRING[10]", "value": "'P1'", "unit": ""} in answer["variables"]
        assert (len(answer["variables"]), answer["more"]) == (256, 1000 - 256)
        with browser() as page:
            page.go(f"{running.url}?token={OPERATE}#/tank/plc")
            page.click("summary", "Variables that are not tags")
            page.sees("tr[data-variable='fill.name']", "'P1'")
            page.sees("tr[data-variable='fill.levels']", "400 elements")
            first = page.sees("tr[data-variable='fill.settled.ET']", "s")
            until(lambda: page.text("tr[data-variable='fill.settled.ET']") != first, "the value changes")
            assert page.complaints() == []
