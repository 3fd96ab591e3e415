"""The page PLC shows charts and ladder diagrams with their present values, in a real Chromium."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from studio_rig import OPERATE, VIEW, studio, until

pytest.importorskip("selenium", reason="needs selenium, which is in the extra dev")
from browser import MISSING, browser

pytestmark = [pytest.mark.long, pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.timeout(180)]

TANK = Path(__file__).parents[3] / "examples" / "first-bug"
CHART = """
FUNCTION_BLOCK Blinker
VAR_OUTPUT lit : BOOL; END_VAR
INITIAL_STEP Dark: END_STEP
STEP Bright: lit(N); END_STEP
TRANSITION FROM Dark TO Bright := Dark.T >= T#300ms; END_TRANSITION
TRANSITION FROM Bright TO Dark := Bright.T >= T#300ms; END_TRANSITION
END_FUNCTION_BLOCK
PROGRAM Fill
VAR_INPUT level : REAL; END_VAR
VAR_OUTPUT run : BOOL; END_VAR
VAR blinker : Blinker; always : BOOL := TRUE; hold : BOOL; END_VAR
INITIAL_STEP Begin: END_STEP
STEP Waiting: Blink(N); END_STEP
STEP Pumping: run(N); END_STEP
TRANSITION FROM Begin TO Waiting := always; END_TRANSITION
TRANSITION FROM Waiting TO Pumping := hold AND level > 1.0E6; END_TRANSITION
TRANSITION FROM Pumping TO Waiting := always; END_TRANSITION
ACTION Blink: blinker(); END_ACTION
END_PROGRAM
"""
LADDER = """<project xmlns="http://www.plcopen.org/xml/tc6_0201"><types><pous><pou name="Fill" pouType="program"><interface>
<inputVars><variable name="level"><type><REAL/></type></variable></inputVars>
<outputVars><variable name="run"><type><BOOL/></type></variable></outputVars>
<localVars><variable name="ready"><type><BOOL/></type><initialValue><simpleValue value="TRUE"/></initialValue></variable>
<variable name="fault"><type><BOOL/></type></variable></localVars></interface><body><LD>
<leftPowerRail localId="1"><position x="0" y="0"/><connectionPointOut/></leftPowerRail>
<contact localId="2"><position x="60" y="20"/><connectionPointIn><connection refLocalId="1"/></connectionPointIn>
<connectionPointOut/><variable>ready</variable></contact>
<contact localId="3"><position x="160" y="20"/><connectionPointIn><connection refLocalId="2"/></connectionPointIn>
<connectionPointOut/><variable>fault</variable></contact>
<coil localId="4"><position x="260" y="20"/><connectionPointIn><connection refLocalId="3"/></connectionPointIn>
<connectionPointOut/><variable>run</variable></coil>
</LD></body></pou></pous></types></project>"""


def site(folder: Path, name: str, text: str) -> Path:
    shutil.copytree(TANK, folder)
    (folder / name).write_text(text)
    system = folder / "tank.yaml"
    system.write_text(system.read_text().replace("source: fill.st", f"source: {name}"))
    return folder


def test_a_chart_shows_active_steps_times_enabled_transitions_and_actions(tmp_path: Path) -> None:
    with studio("tank.yaml", folder=site(tmp_path / "tank", "fill.st", CHART)) as running:
        with running.client(VIEW) as client:
            found = until(lambda: client.get("/instances/tank/plc/drawings").json(), "the PLC answers")
            assert [one["name"] for one in found["fill"]] == ["Fill", "Fill.blinker"]
            values = client.get("/instances/tank/plc/drawings/fill/0").json()
            assert values["transitions"]["2"] == {"enabled": False, "true": True}
            assert client.get("/instances/tank/plc/drawings/fill/7").status_code == 400
        with browser() as page:
            page.go(f"{running.url}?token={OPERATE}#/tank/plc")
            page.sees(".drawing .step.active", "Waiting")
            assert page.text(".drawing .step.active") != page.text(".drawing .step")
            before = page.sees(".drawing .step.active .time", "s")
            until(lambda: page.text(".drawing .step.active .time") != before, "the time in the step advances")
            page.sees(".drawing .transition.enabled", "hold AND level")
            page.sees(".drawing .transition.true", "always")
            page.sees(".drawing .action.active", "Blink")
            assert len(page.elements(".drawing .action.active")) == 1
            page.sees(".active-steps", "Waiting (")
            page.choose("Drawing", "Fill.blinker")
            for step in ("Bright", "Dark"):
                page.sees(".drawing .step.active", step)
            assert page.complaints() == []


def test_a_ladder_shows_the_power_flow(tmp_path: Path) -> None:
    with studio("tank.yaml", folder=site(tmp_path / "tank", "fill.xml", LADDER)) as running, browser() as page:
        page.go(f"{running.url}?token={OPERATE}#/tank/plc")
        page.sees(".drawing .contact.on", "ready")
        assert [one.get_attribute("data-node") for one in page.elements(".drawing .contact.on, .drawing .coil.on")] == [
            "2"
        ]
        assert [one.get_attribute("data-from") for one in page.elements(".drawing .wire.on")] == ["1", "2"]
        assert page.complaints() == []
