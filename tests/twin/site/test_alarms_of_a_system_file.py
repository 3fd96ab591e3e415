"""`fieldtwin check` reports each error in the `alarms` of a system file, with its place and what to do."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.site.check import check_site
from tests.tank_plant import PLANT, write_plant

PUMP = """PROGRAM Pump
VAR_INPUT level : INT; END_VAR
VAR full : BOOL; END_VAR
  full := level > 90;
END_PROGRAM
"""


def errors(folder: Path, alarms: str, plant: str = PLANT) -> list[str]:
    write_plant(folder, plant + f"alarms:\n{alarms}")
    (folder / "pump.st").write_text(PUMP)
    return [str(error).replace(str(folder), "") for error in check_site(folder).errors]


def test_alarms_on_tags_and_variables_are_valid(tmp_path: Path) -> None:
    assert not errors(tmp_path, '  high: {condition: "sensor.level > 80 and pump.full"}\n')


@pytest.mark.parametrize(
    ("alarm", "expected"),
    [
        ('high: {condition: "sensor.levle > 80"}', "plant.yaml:12:22: no tag or variable 'sensor.levle'"),
        ('high: {condition: "pump.ful"}', "did you mean 'pump.full'?"),
        ('high: {condition: "sensor.level >"}', "no expression"),
        ('high: {condition: "1 > 0"}', "the condition refers to no value"),
        ('high: {condition: "age(sensor.level) > 5 s"}', "cannot contain 'age'"),
        ('high: {condition: "plc.late > 5 ms or pump.full"}', "cannot contain 'plc.late'"),
        ('high: {condition: "pump.full", on_delay_ms: -1}', "on_delay_ms"),
        ('high: {condition: "pump.full", priority: urgent}', "priority"),
        ("high: {priority: low}", "condition"),
        ('"too high": {condition: "pump.full"}', "too high"),
    ],
)
def test_an_error_in_an_alarm_is_reported(tmp_path: Path, alarm: str, expected: str) -> None:
    found = errors(tmp_path, f"  {alarm}\n")
    assert len(found) == 1
    assert expected in found[0]


def test_two_alarms_with_the_same_name_are_an_error(tmp_path: Path) -> None:
    found = errors(tmp_path, '  high: {condition: "pump.full"}\n  high: {condition: "pump.full"}\n')
    assert "plant.yaml:13:3: the key 'high' is defined twice (first at line 12)" in found[-1]


def test_every_alarm_with_an_error_is_reported(tmp_path: Path) -> None:
    assert len(errors(tmp_path, '  a: {condition: "x.y"}\n  b: {condition: "pump.full"}\n  c: {condition: "1"}\n')) == 2


def test_no_device_may_have_the_name_of_the_alarms(tmp_path: Path) -> None:
    plant = PLANT.replace("sensor:", "alarm:").replace("sensor.", "alarm.")
    write_plant(tmp_path, plant)
    [error] = [e for e in errors(tmp_path, '  a: {condition: "alarm.level > 1"}\n', plant) if "prototype" not in e]
    assert "the name 'alarm' is reserved in a system with alarms" in error
