"""The alarms, invariants and servers of a system file that use variables of programs, which an online change must keep."""

from __future__ import annotations

from pathlib import Path

from fieldtwin.twin.plant.physical import plc_config
from fieldtwin.twin.site.system import load_system
from tests.tank_plant import PLANT, write_plant

PUMP = """PROGRAM Pump
VAR_INPUT level : INT; END_VAR
VAR full : BOOL; n AT %MW3 : INT; free : INT; END_VAR
  full := level > 90;
END_PROGRAM
"""
USERS = """alarms:
  full: {condition: "pump.full and sensor.level > 3"}
  lost: {condition: "quality(pump.full) == 'bad'"}
invariants:
  always: ["pump.n < 5"]
  never: ["sensor.level < 0", "pump.n > 9"]
  within: [{after: "pump.n > 3", then: "pump.full", within: 2s}]
serve:
  hmi: {url: "tcp://127.0.0.1:0", addresses: openplc}
"""


def test_the_users_of_variables_are_given_to_the_plc(tmp_path: Path) -> None:
    write_plant(tmp_path, PLANT + USERS)
    (tmp_path / "pump.st").write_text(PUMP)
    users = plc_config(load_system(str(tmp_path / "plant.yaml")), tmp_path).users
    assert users == {
        "pump.full": ["alarm full", "alarm lost", "invariant within 1"],
        "pump.n": ["invariant always 1", "invariant never 2", "invariant within 1", "server hmi"],
    }


def test_a_system_without_users_has_none(tmp_path: Path) -> None:
    write_plant(tmp_path)
    (tmp_path / "pump.st").write_text(PUMP)
    assert plc_config(load_system(str(tmp_path / "plant.yaml")), tmp_path).users == {}
