"""The dialog "Why?" of the page PLC shows the statement in Structured Text that made a change, in a real Chromium."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from studio_rig import OPERATE, studio

pytest.importorskip("selenium", reason="needs selenium, which is in the extra dev")
from browser import MISSING, browser

pytestmark = [pytest.mark.long, pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.timeout(180)]

TANK = Path(__file__).parents[3] / "examples" / "first-bug"
PROGRAM = """
PROGRAM Fill
VAR_INPUT level : REAL; END_VAR
VAR_OUTPUT run : BOOL; END_VAR
VAR settled : TON; states : ARRAY[1..2] OF BOOL; n : INT := 2; END_VAR
  settled(IN := TRUE, PT := T#1s);
  IF level > 100000.0 THEN
    run := FALSE;
  ELSIF settled.Q THEN
    states[n] := TRUE;
    run := states[n];
  END_IF
END_PROGRAM
"""


def test_the_statement_and_what_decided_are_shown(tmp_path: Path) -> None:
    shutil.copytree(TANK, tmp_path / "tank")
    (tmp_path / "tank" / "fill.st").write_text(PROGRAM)
    with studio("tank.yaml", folder=tmp_path / "tank") as running, browser() as page:
        page.go(f"{running.url}?token={OPERATE}#/tank/plc")
        page.sees("main", "true")  # the timer has run out
        page.click("tr button", "Why?")
        page.sees("dialog .decision", "run := states[n]")
        page.sees("dialog .conditions", "level > 100000.0 was false")
        page.sees("dialog .conditions", "settled.Q was true")
        page.sees("dialog", "settled.Q")
        page.sees("dialog", "In this line n was 2")
        page.sees("dialog", "In states[2], line")
        assert page.complaints() == []
